// Sweeps as typed arrays; see `pack_sweep` of lidar.view.sweeps.

const COLUMNS = ["ring", "column", "range", "azimuth", "elevation", "time", "intensity", "label", "instance", "echo", "origin"];
const DIFFERENCES = new Set(["ring", "column", "range", "instance"]);

/** JSON with its length before it, and the bytes that follow. */
function split(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const head = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  return [head, new Uint8Array(buffer, 4 + length)];
}

/** Columns of whole numbers of `count` rows from their planes of bytes; those in `sums` add up from row to row. */
function readPlanes(bytes, count, planes, sums) {
  let at = 0;
  return planes.map((ranks, column) => {
    const values = new Float64Array(count);
    for (let rank = 0, weight = 1; rank < ranks; rank++, weight *= 256)
      for (let k = 0; k < count; k++) values[k] += bytes[at++] * weight;
    for (let k = 0; k < count; k++) values[k] = values[k] % 2 ? -(values[k] + 1) / 2 : values[k] / 2;
    if (sums(column)) for (let k = 1; k < count; k++) values[k] += values[k - 1];
    return values;
  });
}

/** Lowest and highest azimuth of a scanner's pulses, radians. */
function azimuthsOf(azimuth, step) {
  let low = Infinity, high = -Infinity;
  for (const value of azimuth) [low, high] = [Math.min(low, value * step), Math.max(high, value * step)];
  return [low, high > low ? high : low + 1];
}

/** The table of directions and times of slots; `step` is the unit of its azimuths. */
function readSlots(buffer, step) {
  const [head, bytes] = split(buffer);
  const [azimuth, elevation, time] = readPlanes(bytes, head.count, head.planes, () => true);
  return { rings: head.rings, columns: head.columns, last: head.count - 1, azimuths: azimuthsOf(azimuth, step), azimuth, elevation, time };
}

/** A sweep: columns of its returns, among them `xyz` in the sensor's frame, its poses and its boxes. */
function readSweep(buffer, slots, steps) {
  const [head, bytes] = split(buffer);
  const { count } = head;
  const values = readPlanes(bytes, count, head.planes, (column) => DIFFERENCES.has(COLUMNS[column]));
  const sweep = Object.fromEntries(COLUMNS.map((name, k) => [name, values[k]]));
  const xyz = new Float32Array(3 * count);
  for (let k = 0; k < count; k++) {
    const row = sweep.ring[k] * slots.columns + sweep.column[k];
    const slot = sweep.column[k] < slots.columns && row < slots.last ? row : slots.last;
    const azimuth = slots.azimuth[slot] * steps.table + sweep.azimuth[k] * steps.angle;
    const elevation = slots.elevation[slot] * steps.table + sweep.elevation[k] * steps.angle;
    sweep.range[k] *= steps.range;
    sweep.time[k] = (sweep.time[k] + slots.time[slot]) * steps.time_ns;
    sweep.instance[k] = head.instances[sweep.instance[k]];
    const flat = sweep.range[k] * Math.cos(elevation);
    xyz[3 * k] = flat * Math.cos(azimuth);
    xyz[3 * k + 1] = flat * Math.sin(azimuth);
    xyz[3 * k + 2] = sweep.range[k] * Math.sin(elevation);
  }
  return { ...sweep, count, xyz, poses: head.poses, boxes: head.boxes };
}

/** A vector turned by a quaternion (x, y, z, w), which need not have unit length. */
function turned([x, y, z, w], [a, b, c]) {
  const n = 2 / (x * x + y * y + z * z + w * w);
  const [i, j, k] = [y * c - z * b, z * a - x * c, x * b - y * a];
  return [
    a + n * (w * i + y * k - z * j), b + n * (w * j + z * i - x * k), c + n * (w * k + x * j - y * i),
  ];
}

/** Place of a return in the scene: with the scanner's pose at its own time. */
function placed(sweep, k) {
  const { span, scale, position, quat } = sweep.poses;
  const at = Math.min(1, Math.max(0, sweep.time[k] / span)) * (position.length - 1);
  const first = Math.min(Math.floor(at), position.length - 2), share = at - first;
  const mixed = (rows) => rows[first].map((v, axis) => v + share * (rows[first + 1][axis] - v));
  const moved = turned(mixed(quat), sweep.xyz.subarray(3 * k, 3 * k + 3));
  return mixed(position).map((v, axis) => v + moved[axis] * (axis < 2 ? scale : 1));
}

/** Corners of a box in the scene, those behind first: bit 0 of a number is left, bit 1 up. */
function cornersOf(box) {
  const corners = [];
  for (const x of [-0.5, 0.5]) for (const z of [-0.5, 0.5]) for (const y of [-0.5, 0.5]) {
    const moved = turned([box.qx, box.qy, box.qz, box.qw], [x * box.length, y * box.width, z * box.height]);
    corners.push([box.x + moved[0], box.y + moved[1], box.z + moved[2]]);
  }
  return corners;
}
