// Shaders. `COPIES` is defined for instanced shapes, `PICK` for the picking buffer (the feature under the cursor),
// `DEPTH` for the shadow map.

const VERTEX = `
precision highp float;
precision highp int;
uniform mat4 uMatrix;
uniform vec3 uOffset;   // tile relative to the camera's target, metres
uniform float uStep;    // quantisation step, metres
uniform int uMode;      // 0 look, 1 material, 2 class, 3 feature
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
out vec3 vPoint;
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
#else
  vPoint = uOffset + vec3(aPosition) * uStep;
  vNormal = aNormal;
#endif
  vFeature = aFeature;
  vCode = aCode.x | aCode.y << 8 | aCode.z << 16;
  vColor = aColor;
  if (uMode == 1) vColor = texelFetch(uCodes, ivec2(int(aCode.y), 0), 0).rgb;
  if (uMode == 2) vColor = texelFetch(uCodes, ivec2(int(aCode.x), 1), 0).rgb;
  if (uMode == 3) vColor = texelFetch(uFeatures, ivec2((aFeature + 1) & 4095, (aFeature + 1) >> 12), 0).rgb;
  gl_Position = uMatrix * vec4(vPoint, 1.0);
}`;

const FRAGMENT = `
precision highp float;
precision highp int;
precision highp sampler2DShadow;
in vec3 vPoint;
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
void main() {
  vec3 normal = normalize(vNormal + vec3(0.0, 0.0, 1e-6));
  float sun = max(dot(normal, uSun), 0.0);
  if (sun > 0.0) sun *= lit(normal);
  // Sky light from above, ground light from below; weighted so that a sunlit roof keeps its colour.
  vec3 sky = mix(vec3(0.26, 0.24, 0.22), vec3(0.42, 0.46, 0.52), normal.z * 0.5 + 0.5);
  vec3 base = max(pow(vColor, vec3(2.2)), vec3(0.012)); // edges of black walls stay visible
  if (vFeature == uSelected && vFeature >= 0) base = mix(base, vec3(0.0, 0.8, 1.0), uGlow);
  color = vec4(pow(base * (sky + vec3(0.85, 0.8, 0.7) * sun), vec3(1.0 / 2.2)), 1.0);
}
#endif`;
