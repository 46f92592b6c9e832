// Walls of buildings as planes with a length and a height, on which the shader draws windows.

/** Bytes of a corner of a wall: four u16 in WALL_STEP (along the wall, its length, z and top over the base), four u8 as `Facades` of geoscene.view.looks. */
const WALL_BYTES = 12;
const WALL_STEP = 0.02; // metres
const WALL_ZERO = 100; // metres below the base that u16 can hold

const SIDE = 3, WALL = 1, GUESSED = 4; // bits and values of the column `surface`

/** The wall columns of the faces from `first` to `end`, three corners each; zeros for faces that are no wall with windows. */
function wallBytes(tile, told, first, end) {
  const out = new ArrayBuffer(Math.max(0, end - first) * 3 * WALL_BYTES);
  const u16 = new Uint16Array(out), u8 = new Uint8Array(out);
  const row = new Map();
  tile.facades.feature.forEach((feature, k) => tile.facadeCodes[4 * k] && row.set(feature, k));
  for (const { faces, along } of walls(tile, told, first, end, row)) {
    const spot = (corner) => [0, 1, 2].map((axis) => (tile.vertices[3 * corner + axis] + told.base[axis]) * told.step);
    const corners = faces.flatMap((f) => [...tile.corners.subarray(3 * f, 3 * f + 3)]).map(spot);
    const u = corners.map(([x, y]) => x * along[0] + y * along[1]);
    const start = Math.min(...u), length = Math.max(...u) - start;
    const k = row.get(tile.feature[faces[0]]), base = tile.facades.base[k];
    const top = Math.max(...corners.map((p) => p[2])) - base;
    corners.forEach((p, n) => {
      const at = (3 * (faces[(n / 3) | 0] - first) + (n % 3)) * WALL_BYTES;
      const metres = [u[n] - start, length, p[2] - base + WALL_ZERO, top + WALL_ZERO];
      metres.forEach((m, j) => { u16[at / 2 + j] = Math.min(65535, Math.max(0, Math.round(m / WALL_STEP))); });
      u8.set(tile.facadeCodes.subarray(4 * k, 4 * k + 4), at + 8);
    });
  }
  return out;
}

/** Upright faces of buildings with windows, joined where they share an edge and lie in one plane, and the direction along each such wall. */
function walls(tile, told, first, end, row) {
  const parent = new Map(), normal = new Map(), edges = new Map();
  const root = (f) => {
    while (parent.get(f) !== f) f = parent.get(f);
    return f;
  };
  for (let f = first; f < end; f++) {
    if ((tile.surface[f] & SIDE) !== WALL || !row.has(tile.feature[f])) continue;
    const [a, b, c] = [0, 1, 2].map((k) => 3 * tile.corners[3 * f + k]);
    const ab = [0, 1, 2].map((axis) => tile.vertices[b + axis] - tile.vertices[a + axis]);
    const ac = [0, 1, 2].map((axis) => tile.vertices[c + axis] - tile.vertices[a + axis]);
    const n = [ab[1] * ac[2] - ab[2] * ac[1], ab[2] * ac[0] - ab[0] * ac[2], ab[0] * ac[1] - ab[1] * ac[0]];
    const size = Math.hypot(...n), flat = Math.hypot(n[0], n[1]);
    if (!size || flat < 0.95 * size) continue;
    parent.set(f, f);
    normal.set(f, [n[0] / flat, n[1] / flat, size]);
    for (const [p, q] of [[a, b], [b, c], [c, a]]) {
      const key = Math.min(p, q) * 67108864 + Math.max(p, q);
      const other = edges.get(key);
      if (other === undefined) edges.set(key, f);
      else if (normal.get(other)[0] * normal.get(f)[0] + normal.get(other)[1] * normal.get(f)[1] > 0.998) parent.set(root(f), root(other));
    }
  }
  const joined = new Map();
  for (const f of parent.keys()) append(joined, root(f), f);
  return [...joined.values()].map((faces) => {
    const [x, y] = normal.get(faces.reduce((a, b) => (normal.get(b)[2] > normal.get(a)[2] ? b : a)));
    return { faces, along: [-y, x] };
  });
}
