// Drawing of sweeps and lines.

const POSES = 9; // of the scanner over a sweep
const POINT_BYTES = 28; // of a return on the graphics card: x, y, z, time f32; codes 4 x u8; instance, ring i32
const BACKGROUND = [0.063, 0.071, 0.094, 1];

const POINT_VERTEX = `
precision highp float;
precision highp int;
uniform mat4 uMatrix;
uniform vec3 uAt[${POSES}];    // the scanner relative to the camera's target, metres
uniform vec4 uTurn[${POSES}];  // from its axes to the scene's
uniform float uScale;          // scene metres per true metre, horizontally
uniform float uSize;
uniform float uGround;         // height of the ground at the vehicle, relative to the target
uniform float uFar;            // metres
uniform float uRings;
uniform int uMode;
uniform int uPicked;           // number of the return that is marked
uniform sampler2D uColors;     // rows: classes, ramp, distinct colours
layout(location = 0) in vec3 aPoint;
layout(location = 1) in float aTime;  // share of the sweep
layout(location = 2) in uvec4 aCode;  // class, intensity, echo, origin
layout(location = 3) in int aInstance;
layout(location = 4) in int aRing;
flat out vec3 vColor;
vec3 ramp(float share) { return texelFetch(uColors, ivec2(int(clamp(share, 0.0, 1.0) * 255.0), 1), 0).rgb; }
vec3 distinct(int k) { return texelFetch(uColors, ivec2(k, 2), 0).rgb; }
void main() {
  float at = clamp(aTime, 0.0, 1.0) * float(${POSES - 1});
  int first = min(int(at), ${POSES - 2});
  vec4 q = normalize(mix(uTurn[first], uTurn[first + 1], at - float(first)));
  vec3 turned = aPoint + 2.0 * cross(q.xyz, cross(q.xyz, aPoint) + q.w * aPoint);
  vec3 point = mix(uAt[first], uAt[first + 1], at - float(first)) + turned * vec3(uScale, uScale, 1.0);
  gl_Position = uMatrix * vec4(point, 1.0);
  gl_PointSize = gl_VertexID == uPicked ? uSize + 7.0 : uSize;
  if (uMode == 0) vColor = texelFetch(uColors, ivec2(int(aCode.x), 0), 0).rgb;
  else if (uMode == 1) vColor = ramp((point.z - uGround + 1.0) / 11.0);
  else if (uMode == 2) vColor = ramp(float(aCode.y) / 100.0);
  else if (uMode == 3) {
    uint h = uint(aInstance) * 2654435761u;
    float hue = float(h >> 8) / 16777216.0 * 6.0;
    vec3 pure = clamp(vec3(abs(hue - 3.0) - 1.0, 2.0 - abs(hue - 2.0), 2.0 - abs(hue - 4.0)), 0.0, 1.0);
    vColor = aInstance < 0 ? vec3(0.45) : mix(vec3(1.0), pure, 0.65);
  }
  else if (uMode == 4) vColor = ramp(aTime);
  else if (uMode == 5) vColor = distinct(int(aCode.z) % 7);
  else if (uMode == 6) vColor = aCode.w == 0u ? vec3(0.5) : distinct(int(aCode.w - 1u) % 7);
  else if (uMode == 7) vColor = ramp(sqrt(length(aPoint) / uFar));
  else vColor = ramp(float(aRing) / max(uRings - 1.0, 1.0));
  if (gl_VertexID == uPicked) vColor = vec3(1.0, 0.2, 0.9);
}`;

const POINT_FRAGMENT = `
precision highp float;
flat in vec3 vColor;
out vec4 color;
void main() { color = vec4(vColor, 1.0); }`;

const LINE_VERTEX = `
precision highp float;
uniform mat4 uMatrix;
layout(location = 0) in vec3 aPoint;
layout(location = 1) in vec3 aColor;
out vec3 vColor;
void main() {
  vColor = aColor;
  gl_Position = uMatrix * vec4(aPoint, 1.0);
}`;

const LINE_FRAGMENT = `
precision highp float;
in vec3 vColor;
out vec4 color;
void main() { color = vec4(vColor, 1.0); }`;

class Renderer {
  constructor(canvas, head) {
    const gl = contextOf(canvas);
    Object.assign(this, { canvas, gl, head, mode: 0, size: 2, picked: -1 });
    this.points = programOf(gl, POINT_VERTEX, POINT_FRAGMENT);
    this.lines = programOf(gl, LINE_VERTEX, LINE_FRAGMENT);
    this.lineArray = gl.createVertexArray();
    this.lineBuffer = gl.createBuffer();
    gl.bindVertexArray(this.lineArray);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.lineBuffer);
    for (const k of [0, 1]) {
      gl.enableVertexAttribArray(k);
      gl.vertexAttribPointer(k, 3, gl.FLOAT, false, 24, 12 * k);
    }
    gl.bindVertexArray(null);
    const colors = new Uint8Array(256 * 3 * 4);
    for (const [code, [, rgb]] of Object.entries(head.classes)) colors.set(rgb, 4 * code);
    head.ramp.forEach((rgb, k) => colors.set(rgb, 1024 + 4 * k));
    head.distinct.forEach((rgb, k) => colors.set(rgb, 2048 + 4 * k));
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, 256, 3, 0, gl.RGBA, gl.UNSIGNED_BYTE, colors);
    gl.enable(gl.DEPTH_TEST);
  }

  /** Put a sweep on the graphics card. */
  load(sweep) {
    const { gl } = this;
    const data = new ArrayBuffer(sweep.count * POINT_BYTES);
    const f32 = new Float32Array(data), i32 = new Int32Array(data), u8 = new Uint8Array(data);
    for (let k = 0; k < sweep.count; k++) {
      const at = (k * POINT_BYTES) / 4;
      f32.set(sweep.xyz.subarray(3 * k, 3 * k + 3), at);
      f32[at + 3] = sweep.time[k] / sweep.poses.span;
      u8.set([sweep.label[k], sweep.intensity[k], sweep.echo[k], sweep.origin[k]], 4 * at + 16);
      i32[at + 5] = sweep.instance[k];
      i32[at + 6] = sweep.ring[k];
    }
    const array = gl.createVertexArray(), buffer = gl.createBuffer();
    gl.bindVertexArray(array);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
    for (let k = 0; k < 5; k++) gl.enableVertexAttribArray(k);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, POINT_BYTES, 0);
    gl.vertexAttribPointer(1, 1, gl.FLOAT, false, POINT_BYTES, 12);
    gl.vertexAttribIPointer(2, 4, gl.UNSIGNED_BYTE, POINT_BYTES, 16);
    gl.vertexAttribIPointer(3, 1, gl.INT, POINT_BYTES, 20);
    gl.vertexAttribIPointer(4, 1, gl.INT, POINT_BYTES, 24);
    gl.bindVertexArray(null);
    sweep.onCard = { array, buffer };
  }

  /** Remove a sweep from the graphics card. */
  drop({ onCard }) {
    this.gl.deleteVertexArray(onCard.array);
    this.gl.deleteBuffer(onCard.buffer);
  }

  /** The picture: sweeps, of which the last is current, and lines [from, to, colour] in scene metres. */
  render(camera, sweeps, lines, { ground }) {
    const { gl, canvas } = this;
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const [width, height] = [Math.round(canvas.clientWidth * ratio), Math.round(canvas.clientHeight * ratio)];
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    gl.viewport(0, 0, width, height);
    gl.clearColor(...BACKGROUND);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const matrix = camera.matrix(width / height), { target } = camera;
    const { program, at } = this.points;
    gl.useProgram(program);
    gl.uniformMatrix4fv(at.uMatrix, false, matrix);
    gl.uniform1f(at.uSize, this.size * ratio);
    gl.uniform1f(at.uGround, ground - target[2]);
    gl.uniform1i(at.uMode, this.mode);
    gl.uniform1i(at.uColors, 0);
    sweeps.forEach((sweep, k) => {
      const { position, quat, scale } = sweep.poses;
      gl.uniform3fv(at["uAt[0]"], position.flatMap((p) => p.map((v, axis) => v - target[axis])));
      gl.uniform4fv(at["uTurn[0]"], quat.flat());
      gl.uniform1f(at.uScale, scale);
      gl.uniform1f(at.uFar, sweep.far);
      gl.uniform1f(at.uRings, sweep.slots.rings);
      gl.uniform1i(at.uPicked, k === sweeps.length - 1 ? this.picked : -1);
      gl.bindVertexArray(sweep.onCard.array);
      gl.drawArrays(gl.POINTS, 0, sweep.count);
    });
    if (!lines.length) return;
    const data = new Float32Array(12 * lines.length);
    lines.forEach(([from, to, color], k) => {
      data.set([...from.map((v, axis) => v - target[axis]), ...color], 12 * k);
      data.set([...to.map((v, axis) => v - target[axis]), ...color], 12 * k + 6);
    });
    gl.useProgram(this.lines.program);
    gl.uniformMatrix4fv(this.lines.at.uMatrix, false, matrix);
    gl.bindVertexArray(this.lineArray);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.lineBuffer);
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STREAM_DRAW);
    gl.drawArrays(gl.LINES, 0, 2 * lines.length);
    gl.bindVertexArray(null);
  }
}

/** Edges of boxes and their headings, as lines; those without returns are dim. */
function boxLines(boxes, classes) {
  const lines = [];
  for (const box of boxes) {
    const color = classes[box.class][1].map((v) => (v / 255) * 0.6 + 0.4).map((v) => (box.points ? v : v * 0.4));
    const corners = cornersOf(box);
    for (let k = 0; k < 8; k++) for (const bit of [1, 2, 4]) if (!(k & bit)) lines.push([corners[k], corners[k | bit], color]);
    const middle = (numbers) => [0, 1, 2].map((axis) => numbers.reduce((sum, k) => sum + corners[k][axis], 0) / numbers.length);
    lines.push([middle([0, 1, 4, 5]), middle([4, 5]), color]);
  }
  return lines;
}
