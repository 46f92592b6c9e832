// A camera that orbits a target point. Coordinates on the graphics card are relative to the target, so that single
// precision suffices far from the scene's origin.

const FIELD = Math.PI / 4; // vertical angle of view
const LOWEST = 0.02, HIGHEST = Math.PI / 2; // tilt

/** Product of 4 x 4 matrices, columns first, as WebGL has them. */
function product(a, b) {
  const out = new Float32Array(16);
  for (let c = 0; c < 4; c++)
    for (let r = 0; r < 4; r++)
      for (let k = 0; k < 4; k++) out[4 * c + r] += a[4 * k + r] * b[4 * c + k];
  return out;
}

/** Rotation to the axes right, up, back (rows), then a shift. */
function toAxes(right, up, back, shift) {
  return new Float32Array([
    right[0], up[0], back[0], 0, right[1], up[1], back[1], 0, right[2], up[2], back[2], 0, ...shift, 1,
  ]);
}

class Camera {
  /** low, high: box of the scene. */
  constructor(low, high) {
    this.low = low;
    this.high = high;
    this.whole();
  }

  /** See all of the scene, or a part of it, in a picture of a given width by height. */
  whole({ low, high } = this, aspect = 1.5) {
    const across = Math.max(100, Math.hypot(high[0] - low[0], high[1] - low[1]));
    this.azimuth = -0.5; // of the direction of view, clockwise from grid north
    this.tilt = 0.75; // below the horizon
    this.distance = (0.8 * across) / Math.min(1, aspect);
    this.target = [(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2] + (high[2] - low[2]) * 0.1];
    this.move(0, -0.08 * across); // nearby things appear larger
  }

  axes() {
    const [sa, ca, st, ct] = [Math.sin(this.azimuth), Math.cos(this.azimuth), Math.sin(this.tilt), Math.cos(this.tilt)];
    return { right: [ca, -sa, 0], up: [sa * st, ca * st, ct], forward: [sa * ct, ca * ct, -st] };
  }

  /** Where the camera is, in scene metres. */
  eye() {
    const { forward } = this.axes();
    return this.target.map((t, k) => t - this.distance * forward[k]);
  }

  /** Clip coordinates from metres relative to the target. */
  matrix(aspect) {
    const { right, up, forward } = this.axes();
    const corner = [0, 1, 2].map((k) => Math.max(Math.abs(this.low[k] - this.target[k]), Math.abs(this.high[k] - this.target[k])));
    const near = Math.max(0.2, this.distance / 60), far = this.distance + Math.hypot(...corner) + 10;
    const f = 1 / Math.tan(FIELD / 2);
    const projection = new Float32Array([
      f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / (near - far), -1, 0, 0, (2 * far * near) / (near - far), 0,
    ]);
    return product(projection, toAxes(right, up, forward.map((v) => -v), [0, 0, -this.distance]));
  }

  /** Metres of a pixel at the target. */
  pixel(height) {
    return (2 * this.distance * Math.tan(FIELD / 2)) / height;
  }

  turn(azimuth, tilt) {
    this.azimuth += azimuth;
    this.tilt = Math.min(HIGHEST, Math.max(LOWEST, this.tilt + tilt));
  }

  /** Move along the ground: metres to the right and away. */
  move(right, away) {
    const { right: r } = this.axes();
    this.target[0] += right * r[0] - away * r[1];
    this.target[1] += right * r[1] + away * r[0];
    for (const k of [0, 1]) this.target[k] = Math.min(this.high[k], Math.max(this.low[k], this.target[k]));
  }

  /** Come closer (factor below 1) to a point given relative to the target. */
  zoom(factor, point = [0, 0, 0]) {
    const next = Math.min(20 * Math.hypot(...this.high.map((h, k) => h - this.low[k])), Math.max(2, this.distance * factor));
    const share = 1 - next / this.distance;
    this.target = this.target.map((t, k) => t + share * point[k]);
    this.distance = next;
  }

  /** Turn about what is seen in the middle of the picture, given relative to the target; the picture stays. */
  settle(point) {
    const { forward } = this.axes();
    const along = this.distance + forward.reduce((sum, f, k) => sum + f * point[k], 0);
    if (along < 2) return;
    this.target = this.target.map((t, k) => t + forward[k] * (along - this.distance));
    this.distance = along;
  }

  lookAt(point, distance) {
    this.target = [...point];
    this.distance = distance;
  }

  /** x, y, z, distance, azimuth and tilt in degrees, for the address. */
  toText() {
    const degrees = [this.azimuth, this.tilt].map((a) => ((a * 180) / Math.PI).toFixed(1));
    return [...this.target.map((t) => t.toFixed(1)), this.distance.toFixed(1), ...degrees].join(",");
  }

  fromText(text) {
    const v = text.split(",").map(Number);
    if (v.length !== 6 || !v.every(Number.isFinite) || v[3] <= 0) return;
    this.target = v.slice(0, 3);
    this.distance = v[3];
    this.azimuth = (v[4] * Math.PI) / 180;
    this.tilt = Math.min(HIGHEST, Math.max(LOWEST, (v[5] * Math.PI) / 180));
  }
}
