// The scene as typed arrays.

/** Bytes of a vertex of the graphics card: position 4 x u16, feature i32, normal 4 x i8, codes and colour 4 x u8. */
const VERTEX_BYTES = 24;

/** Unit normal of a triangle, times 127, as int8 (zero without area). */
function normalOf(a, b, c, out) {
  const ux = b[0] - a[0], uy = b[1] - a[1], uz = b[2] - a[2];
  const vx = c[0] - a[0], vy = c[1] - a[1], vz = c[2] - a[2];
  const x = uy * vz - uz * vy, y = uz * vx - ux * vz, z = ux * vy - uy * vx;
  const scale = 127 / (Math.hypot(x, y, z) || 1);
  out[0] = Math.round(x * scale); out[1] = Math.round(y * scale); out[2] = Math.round(z * scale);
}

/** Columns of a tile's bytes; see `pack_tile` of geoscene.view.tiles. */
function readTile(told, buffer) {
  const n = told.vertices, m = told.ends[told.ends.length - 1];
  const k = told.runs.reduce((sum, run) => sum + run[2], 0);
  let at = 0;
  const take = (Type, count) => {
    const values = new Type(buffer, at, count);
    at += values.byteLength;
    return values;
  };
  return {
    corners: take(Uint32Array, 3 * m), feature: take(Int32Array, m),
    copied: take(Int32Array, k),
    facades: { feature: take(Int32Array, told.facades), base: take(Float32Array, told.facades) },
    vertices: take(Uint16Array, 3 * n),
    klass: take(Uint8Array, m), material: take(Uint8Array, m), surface: take(Uint8Array, m),
    color: take(Uint8Array, 3 * m),
    facadeCodes: take(Uint8Array, 4 * told.facades),
    transform: told.upright ? readUpright(take(Uint8Array, 12 * k), k, told.step) : readTransforms(take(Uint8Array, 48 * k), k),
  };
}

/** Transforms (rows of 3 x 4) of copies that are scaled and turned about the vertical alone. */
function readUpright(bytes, k, step) {
  const out = new Float32Array(12 * k);
  const column = (c, copy) => bytes[2 * c * k + copy] | (bytes[(2 * c + 1) * k + copy] << 8);
  let x = 0;
  for (let copy = 0; copy < k; copy++) {
    x = (x + column(0, copy)) & 65535;
    const turn = (column(3, copy) * Math.PI) / 1024, along = column(4, copy) / 256;
    const c = along * Math.cos(turn), s = along * Math.sin(turn);
    const rows = [c, -s, 0, x * step, s, c, 0, column(1, copy) * step, 0, 0, column(5, copy) / 256, column(2, copy) * step];
    for (let n = 0; n < 12; n++) out[12 * copy + n] = rows[n];
  }
  return out;
}

/** Transforms of any other copies: twelve columns of floats, their bytes by rank. */
function readTransforms(bytes, k) {
  const out = new Float32Array(12 * k), raw = new Uint8Array(out.buffer);
  for (let c = 0; c < 12; c++)
    for (let b = 0; b < 4; b++)
      for (let copy = 0; copy < k; copy++) raw[48 * copy + 4 * c + b] = bytes[(4 * c + b) * k + copy];
  return out;
}

/** Shapes that are copied, each with its columns and a box; see `pack_shapes` of geoscene.view.tiles. */
function readShapes(counts, buffer) {
  let at = 0;
  return counts.map(([n, m]) => {
    const take = (Type, count) => {
      const values = new Type(buffer, at, count);
      at += values.byteLength;
      return values;
    };
    const shape = {
      vertices: take(Float32Array, 3 * n), corners: take(Uint32Array, 3 * m),
      klass: take(Uint8Array, m), material: take(Uint8Array, m), surface: take(Uint8Array, m),
      color: take(Uint8Array, 3 * m),
      low: [Infinity, Infinity, Infinity], high: [-Infinity, -Infinity, -Infinity],
    };
    at += -at & 3;
    for (let v = 0; v < 3 * n; v++) {
      shape.low[v % 3] = Math.min(shape.low[v % 3], shape.vertices[v]);
      shape.high[v % 3] = Math.max(shape.high[v % 3], shape.vertices[v]);
    }
    return shape;
  });
}

/** What stands for a shape far away: eight faces between the middles of its box's sides, of its mean colour. */
function farShape(shape) {
  const { low, high } = shape, middle = low.map((v, k) => (v + high[k]) / 2);
  const points = [0, 1, 2].flatMap((axis) => [low, high].map((end) => middle.map((v, k) => (k === axis ? end[k] : v))));
  const corners = [];
  for (const x of [0, 1]) for (const y of [2, 3]) for (const z of [4, 5])
    corners.push(...((x + y + z) % 2 ? [x, y, z] : [y, x, z]));
  const faces = shape.klass.length, color = [0, 0, 0];
  for (let k = 0; k < 3 * faces; k++) color[k % 3] += shape.color[k] / faces;
  const eight = (value) => new Uint8Array(8).fill(value);
  return {
    low, high, vertices: new Float32Array(points.flat()), corners: new Uint32Array(corners),
    klass: eight(shape.klass[0]), material: eight(shape.material[0]), surface: eight(shape.surface[0]),
    color: new Uint8Array(Array.from({ length: 8 }, () => color).flat()),
  };
}

/** Metres of the longest and of the second side of the largest of some copies of a shape. */
function sidesOf(shape, transform, first, count) {
  const sides = [0, 0, 0];
  for (let copy = first; copy < first + count; copy++)
    for (let axis = 0; axis < 3; axis++) {
      const at = 12 * copy + axis;
      const scale = Math.hypot(transform[at], transform[at + 4], transform[at + 8]);
      sides[axis] = Math.max(sides[axis], scale * (shape.high[axis] - shape.low[axis]));
    }
  return sides.sort((a, b) => b - a);
}

/**
 * Three vertices a face, as VERTEX_BYTES says; each carries all of its face, so that shading is flat.
 * Positions of shapes, which are not whole steps, are given apart as floats.
 */
function vertexBytes(part, step) {
  const faces = part.klass.length;
  const buffer = new ArrayBuffer(faces * 3 * VERTEX_BYTES);
  const u16 = new Uint16Array(buffer), i32 = new Int32Array(buffer);
  const i8 = new Int8Array(buffer), u8 = new Uint8Array(buffer);
  const corner = [[0, 0, 0], [0, 0, 0], [0, 0, 0]], normal = [0, 0, 0];
  for (let f = 0; f < faces; f++) {
    for (let c = 0; c < 3; c++) {
      const v = 3 * part.corners[3 * f + c];
      for (let axis = 0; axis < 3; axis++) corner[c][axis] = part.vertices[v + axis] * step;
    }
    normalOf(corner[0], corner[1], corner[2], normal);
    for (let c = 0; c < 3; c++) {
      const v = 3 * part.corners[3 * f + c], at = (3 * f + c) * VERTEX_BYTES;
      for (let axis = 0; axis < 3; axis++) {
        u16[at / 2 + axis] = part.vertices[v + axis];
        i8[at + 12 + axis] = normal[axis];
        u8[at + 20 + axis] = part.color[3 * f + axis];
      }
      i32[at / 4 + 2] = part.feature ? part.feature[f] : -1;
      u8[at + 16] = part.klass[f];
      u8[at + 17] = part.material[f];
      u8[at + 18] = part.surface[f];
    }
  }
  return buffer;
}

/** Positions (3 a face, floats) of a shape, in the order of `vertexBytes`. */
function shapePositions(shape) {
  const out = new Float32Array(3 * shape.corners.length);
  shape.corners.forEach((v, k) => out.set(shape.vertices.subarray(3 * v, 3 * v + 3), 3 * k));
  return out;
}

/** Boxes of the features in metres: low and high as 3 floats each, empty where low > high; see `Contents.boxes`. */
class Boxes {
  constructor(count, buffer) {
    this.low = new Float32Array(3 * count).fill(Infinity);
    this.high = new Float32Array(3 * count).fill(-Infinity);
    const values = new Int32Array(buffer), n = values.length / 7;
    for (let row = 0; row < n; row++)
      for (let axis = 0; axis < 3; axis++) {
        this.low[3 * values[row] + axis] = values[(1 + axis) * n + row] / 100;
        this.high[3 * values[row] + axis] = values[(4 + axis) * n + row] / 100;
      }
  }

  has(feature) {
    return this.low[3 * feature] <= this.high[3 * feature];
  }

  middle(feature) {
    return [0, 1, 2].map((axis) => (this.low[3 * feature + axis] + this.high[3 * feature + axis]) / 2);
  }

  size(feature) {
    return Math.hypot(...[0, 1, 2].map((axis) => this.high[3 * feature + axis] - this.low[3 * feature + axis]));
  }
}

/** What is known of the features, by feature number. */
class Attributes {
  constructor(tables) {
    this.tables = tables;
    this.rows = new Map(); // feature -> [table, row]
    this.parts = new Map(); // building -> features of its parts
    this.edges = new Map(); // OSM id -> features of the road edges made of it
    this.surfaces = new Map(); // OSM id -> a feature of the road surfaces made of it
    for (const table of tables) {
      table.feature.forEach((feature, row) => {
        this.rows.set(feature, [table, row]);
        const ids = this.ids(feature);
        if (table.layer === "building_parts") append(this.parts, this.value(feature, "building"), feature);
        if (table.layer === "roads") ids.forEach((id) => append(this.edges, id, feature));
        if (table.layer === "road_surfaces") ids.forEach((id) => this.addSurface(id, feature));
      });
    }
  }

  /** Of the surfaces of a way, its carriageway stands for it. */
  addSurface(id, feature) {
    if (!this.surfaces.has(id) || this.value(feature, "class") === "road") this.surfaces.set(id, feature);
  }

  layer(feature) {
    return this.rows.has(feature) ? this.rows.get(feature)[0].layer : null;
  }

  names(feature) {
    return this.rows.has(feature) ? Object.keys(this.rows.get(feature)[0].columns) : [];
  }

  /** The value in a column; null if it is not known. */
  value(feature, column) {
    if (!this.rows.has(feature)) return null;
    const [table, row] = this.rows.get(feature);
    const values = table.columns[column];
    if (values === undefined) return null;
    if (Array.isArray(values)) return values[row];
    return values.index[row] < 0 ? null : values.words[values.index[row]];
  }

  /** OSM ids, such as way/123. */
  ids(feature) {
    return (this.value(feature, "osm_id") || "").split(";").filter(Boolean);
  }

  /** The feature that is seen in place of one without faces: a part's building, an edge's surface. */
  seen(feature) {
    const layer = this.layer(feature);
    if (layer === "building_parts") return this.value(feature, "building");
    if (layer === "roads") {
      const id = this.ids(feature).find((way) => this.surfaces.has(way));
      return id === undefined ? feature : this.surfaces.get(id);
    }
    return feature;
  }
}

function append(map, key, value) {
  if (!map.has(key)) map.set(key, []);
  map.get(key).push(value);
}

/** Longitude and latitude in degrees of scene coordinates, bilinear. */
function toLonLat(grid, x, y) {
  const [xmin, ymin, xmax, ymax] = grid.bounds;
  const last = grid.lon.length - 1;
  let u = ((x - xmin) / (xmax - xmin)) * last, v = ((y - ymin) / (ymax - ymin)) * last;
  const i = Math.max(0, Math.min(last - 1, Math.floor(u)));
  const j = Math.max(0, Math.min(last - 1, Math.floor(v)));
  u -= i; v -= j;
  return [grid.lon, grid.lat].map((d) =>
    (1 - u) * (1 - v) * d[j][i] + u * (1 - v) * d[j][i + 1] + (1 - u) * v * d[j + 1][i] + u * v * d[j + 1][i + 1]);
}
