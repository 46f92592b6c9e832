// Shaders. `COPIES` is defined for instanced shapes, `PICK` for the picking buffer (the feature under the cursor),
// `DEPTH` for the shadow map.

const VERTEX = `
precision highp float;
precision highp int;
uniform mat4 uMatrix;
uniform vec3 uOffset;   // tile relative to the camera's target, metres
uniform float uStep;    // quantisation step, metres
uniform int uMode;      // 0 look, 1 material, 2 class, 3 feature
uniform int uGuesses;   // whether guessed colours and windows are shown
uniform sampler2D uCodes;     // rows: materials, classes
uniform sampler2D uFeatures;  // colour of feature f at (f + 1) in rows of 4096
#ifdef COPIES
layout(location = 0) in vec3 aPosition;
layout(location = 5) in vec4 aRow0;
layout(location = 6) in vec4 aRow1;
layout(location = 7) in vec4 aRow2;
#else
layout(location = 0) in uvec3 aPosition;
#endif
layout(location = 1) in int aFeature;
layout(location = 2) in vec3 aNormal;
layout(location = 3) in uvec3 aCode;  // class, material, surface
layout(location = 4) in vec3 aColor;
#ifndef COPIES
layout(location = 8) in vec4 aWall;    // see WALL_BYTES; zeros where there are no windows
layout(location = 9) in vec4 aFacade;
#endif
out vec3 vPoint;
out vec4 vWall;
flat out vec4 vFacade;
flat out vec3 vNormal;
flat out vec3 vColor;
flat out int vFeature;
flat out uint vCode;
void main() {
#ifdef COPIES
  vec4 p = vec4(aPosition, 1.0);
  vPoint = uOffset + vec3(dot(aRow0, p), dot(aRow1, p), dot(aRow2, p));
  // Normals transform with the cofactor matrix, which holds for any scales.
  vec3 r0 = aRow0.xyz, r1 = aRow1.xyz, r2 = aRow2.xyz;
  vNormal = vec3(dot(cross(r1, r2), aNormal), dot(cross(r2, r0), aNormal), dot(cross(r0, r1), aNormal));
  vWall = vFacade = vec4(0.0);
#else
  vPoint = uOffset + vec3(aPosition) * uStep;
  vNormal = aNormal;
  vWall = vec4(aWall.xy, aWall.zw - ${WALL_ZERO / WALL_STEP}.0) * ${WALL_STEP};
  vFacade = uMode == 0 && uGuesses == 1 ? aFacade : vec4(0.0);
#endif
  vFeature = aFeature;
  vCode = aCode.x | aCode.y << 8 | aCode.z << 16;
  vColor = aColor;
  bool hidden = uGuesses == 0 && (aCode.z & 4u) != 0u;
  if (uMode == 1 || hidden) vColor = texelFetch(uCodes, ivec2(int(aCode.y), 0), 0).rgb;
  if (uMode == 2) vColor = texelFetch(uCodes, ivec2(int(aCode.x), 1), 0).rgb;
  if (uMode == 3) vColor = texelFetch(uFeatures, ivec2((aFeature + 1) & 4095, (aFeature + 1) >> 12), 0).rgb;
  gl_Position = uMatrix * vec4(vPoint, 1.0);
}`;

const FRAGMENT = `
precision highp float;
precision highp int;
precision highp sampler2DShadow;
in vec3 vPoint;
in vec4 vWall;
flat in vec4 vFacade;
flat in vec3 vNormal;
flat in vec3 vColor;
flat in int vFeature;
flat in uint vCode;
#if defined(DEPTH)
void main() {}
#elif defined(PICK)
layout(location = 0) out uvec4 number;  // feature + 2 (0 is the sky) and the point's bits
layout(location = 1) out uvec4 code;
void main() {
  number = uvec4(uint(vFeature + 2), floatBitsToUint(vPoint));
  code = uvec4(vCode, 0u, 0u, 0u);
}
#else
uniform vec3 uSun;      // towards the sun
uniform int uSelected;
uniform float uGlow;    // strength of the highlight of the selected feature
uniform int uShadows;
uniform mat4 uSunMatrix;
uniform float uSunPixel;  // metres
uniform sampler2DShadow uSunDepth;
out vec4 color;
float lit(vec3 normal) {
  // Offset by a pixel and a half, so that a face does not shade itself.
  vec3 at = (uSunMatrix * vec4(vPoint + normal * 1.5 * uSunPixel, 1.0)).xyz * 0.5 + 0.5;
  if (uShadows == 0 || any(lessThan(at, vec3(0.0))) || any(greaterThan(at, vec3(1.0)))) return 1.0;
  vec2 pixel = 0.7 / vec2(textureSize(uSunDepth, 0));
  float sum = 0.0;
  for (int k = 0; k < 4; k++) {
    vec2 shift = vec2(float(k & 1) * 2.0 - 1.0, float(k & 2) - 1.0) * pixel;
    sum += texture(uSunDepth, vec3(at.xy + shift, at.z - 0.0002));
  }
  return sum * 0.25;
}
/** Share of the interval of a width about x that lies in [k + ends.x, k + ends.y] of any whole k. */
float share(float x, vec2 ends, float width) {
  vec2 at = x + vec2(-0.5, 0.5) * max(width, 1e-3);
  vec2 sum = floor(at) * (ends.y - ends.x) + clamp(fract(at) - ends.x, 0.0, ends.y - ends.x);
  return (sum.y - sum.x) / max(width, 1e-3);
}
/** The colour of a wall with windows on it: kinds are those of WINDOWS of geoscene.buildings.guesses. */
vec3 withWindows(vec3 wall) {
  float kind = vFacade.x, storey = max(vFacade.z, 1.0) * 0.05, bay = max(vFacade.w, 1.0) * 0.05;
  float along = vWall.x - 0.3, width = vWall.y - 0.6, z = vWall.z, top = vWall.w;
  float count = max(1.0, floor(width / bay + 0.3)), metres = max(width, 0.1) / count;
  float rows = min(vFacade.y, floor((top + 0.4) / storey));
  vec2 at = vec2(along / metres, z / storey);
  float half_ = min(0.55, 0.3 * metres) / metres;
  vec4 box = vec4(0.5 - half_, 0.5 + half_, 0.32, 0.8);
  if (kind == 2.0 && at.y < 1.0) box = vec4(0.06, 0.94, 0.06, 0.72);
  if (kind == 3.0) box = vec4(0.03, 0.97, 0.32, 0.86);
  if (kind >= 4.0) rows = top > 4.0 ? 1.0 : 0.0;
  if (kind == 4.0) {
    at.y = (z - top + 2.6) / 2.0;
    box = vec4(0.04, 0.96, 0.2, 0.8);
  }
  if (kind == 5.0) {
    at.y = z / max(top, 1.0);
    box.zw = vec2(0.3, 0.75);
  }
  vec2 wide = fwidth(at);
  if (kind == 0.0 || width < 1.0 || at.x < 0.0 || at.x > count || at.y < 0.0 || at.y > rows) return wall;
  float glass = share(at.x, box.xy, wide.x) * share(at.y, box.zw, wide.y);
  float lines = kind < 4.0 && rows > 1.0 ? 0.14 * share(at.y, vec2(0.0, 0.05), wide.y) : 0.0;
  // Panes differ; far away only their mean is seen.
  float pane = fract(sin(dot(floor(at), vec2(12.9898, 78.233)) + float(vFeature & 1023)) * 43758.5453);
  vec3 near = pane > 0.82 ? vec3(0.36, 0.34, 0.3) : mix(vec3(0.03, 0.04, 0.055), vec3(0.13, 0.16, 0.19), pane);
  vec3 color = mix(near, vec3(0.14, 0.15, 0.165), smoothstep(0.3, 0.8, max(wide.x, wide.y)));
  return mix(wall * (1.0 - lines), color, 0.92 * glass);
}
void main() {
  vec3 normal = normalize(vNormal + vec3(0.0, 0.0, 1e-6));
  float sun = max(dot(normal, uSun), 0.0);
  if (sun > 0.0) sun *= lit(normal);
  // Sky light from above, ground light from below; weighted so that a sunlit roof keeps its colour.
  vec3 sky = mix(vec3(0.26, 0.24, 0.22), vec3(0.42, 0.46, 0.52), normal.z * 0.5 + 0.5);
  vec3 base = max(pow(vColor, vec3(2.2)), vec3(0.012)); // edges of black walls stay visible
  base = withWindows(base);
  if (vFeature == uSelected && vFeature >= 0) base = mix(base, vec3(0.0, 0.8, 1.0), uGlow);
  color = vec4(pow(base * (sky + vec3(0.85, 0.8, 0.7) * sun), vec3(1.0 / 2.2)), 1.0);
}
#endif`;
