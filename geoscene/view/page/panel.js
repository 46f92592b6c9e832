// Text: attributes of a feature with their sources, the legend, the search.

const OSM_ID = /^(node|way|relation)\/\d+$/;
const SURFACES = ["", "wall", "roof", "floor"];

/** Columns whose source is not in the column of their name with `_source` after it. */
const SOURCE_OF = {
  roof_shape: "roof_source", roof_height: "roof_source", wall_material: "wall_source",
  roof_material: "roof_look_source", material: "source", class: "source",
};
const SILENT = new Set(["osm_id", "name", "building", "priority"]);
const METRES = new Set(["height", "min_height", "roof_height", "base", "width", "length", "crown", "trunk"]);
const ANGLES = new Set(["heading", "roof_direction"]);

/** Values of `height_source`, what they mean and their colours: green is mapped, blue derived from other tags, red guessed. */
const HEIGHT_SOURCES = {
  tag: ["mapped", [46, 150, 84]],
  height: ["mapped", [46, 150, 84]],
  est_height: ["mapped as an estimate", [140, 186, 66]],
  levels: ["from its storeys", [58, 122, 200]],
  parts: ["from its parts", [106, 92, 196]],
  outline: ["from its outline", [150, 108, 190]],
  "inferred-neighbours": ["guessed from neighbours", [242, 158, 44]],
  "inferred-type": ["guessed from its type", [226, 88, 34]],
  default: ["a default", [178, 38, 30]],
};
const OTHER_SOURCE = ["of another source", [200, 60, 150]];

/** Colours of a standard deviation in metres: up to the first, second ... of these. */
const SIGMAS = [[0.5, [26, 120, 80]], [1, [110, 170, 70]], [2, [200, 200, 70]], [4, [244, 170, 50]], [8, [226, 90, 40]], [Infinity, [140, 20, 50]]];

function isGuess(source) {
  return /default|inferred|assumed|guess/.test(source);
}

/** Centimetres, without a minus before zero. */
function metres(value) {
  return (Math.round(value * 100) / 100 + 0).toFixed(2);
}

/** Degrees from -180 to 180. */
function wrapped(lon) {
  return ((lon + 540) % 360) - 180;
}

/** A value for people, with its unit. */
function told(column, value) {
  if (METRES.has(column)) return `${+value.toFixed(2)} m`;
  if (column === "speed") return `${+(value * 3.6).toFixed(1)} km/h`;
  if (ANGLES.has(column)) return `${(((90 - (value * 180) / Math.PI) % 360 + 360) % 360).toFixed(0)}° from grid north`;
  if (typeof value === "boolean") return value ? "yes" : "no";
  return words(String(value));
}

function osmLinks(ids) {
  return ids.filter((id) => OSM_ID.test(id)).flatMap((id) => [
    make("a", id, { href: `https://www.openstreetmap.org/${id}`, target: "_blank", rel: "noopener" }), " ",
  ]);
}

/** The attributes of a feature as a table: value, source, uncertainty. */
function attributeTable(attributes, feature) {
  const table = make("table");
  for (const column of attributes.names(feature)) {
    const value = attributes.value(feature, column);
    if (value === null || SILENT.has(column) || /(^|_)(source|sigma)$/.test(column)) continue;
    const source = attributes.value(feature, SOURCE_OF[column] || `${column}_source`);
    const sigma = attributes.value(feature, `${column}_sigma`);
    const row = make("tr", [make("td", words(column)), make("td", told(column, value) + (sigma === null ? "" : ` ± ${+sigma.toFixed(2)} m`))]);
    const known = source !== null && source !== "none";
    row.append(make("td", known ? source.replaceAll("-", " ") : "", { className: known && isGuess(source) ? "source guessed" : "source" }));
    table.append(row);
  }
  return table;
}

/** What the panel shows of a feature; `hit` is what was clicked, if it was. */
function describe(head, attributes, feature, hit) {
  const layer = attributes.layer(feature);
  const name = attributes.value(feature, "name") || (layer ? words(layer).replace(/s$/, "") : "bare ground");
  const out = [make("h2", name), make("div", osmLinks(attributes.ids(feature)))];
  if (layer === null) out.push(make("p", "Nothing is mapped here."));
  else out.push(attributeTable(attributes, feature));
  if (hit) {
    const [material, , reflectance] = head.materials[hit.material] || ["unknown", null, null];
    const face = [["class", words((head.classes[hit.klass] || ["unknown"])[0])], ["material", words(material)]];
    if (reflectance) face.push(["reflectance", `${reflectance[0]} at 905 nm, ${reflectance[2]} at 1550 nm`]);
    if (hit.surface) face.push(["surface", SURFACES[hit.surface]]);
    if (hit.guessed) face.push(["colour", make("span", "guess", { className: "guessed" })]);
    face.push(["x, y, z", `${hit.point.map((v) => metres(v)).join(", ")} m in ${head.frame}, heights ${head.vertical}`]);
    const [lon, lat] = toLonLat(head.lonlat, hit.point[0], hit.point[1]);
    face.push(["lat, lon", `${lat.toFixed(7)}, ${wrapped(lon).toFixed(7)}`]);
    out.push(make("h3", "The face clicked"), make("table", face.map((pair) => make("tr", pair.map((text) => make("td", text))))));
  }
  const related = [["part", attributes.parts.get(feature) || []]];
  if (layer === "road_surfaces") related.push(["road edge", [...new Set(attributes.ids(feature).flatMap((id) => attributes.edges.get(id) || []))]]);
  for (const [kind, others] of related) {
    for (const [k, other] of others.entries()) {
      const title = `${kind} ${k + 1} of ${others.length}${attributes.value(other, "name") ? `: ${attributes.value(other, "name")}` : ""}`;
      out.push(make("h3", title), make("div", osmLinks(attributes.ids(other))), attributeTable(attributes, other));
    }
  }
  return out;
}

/** Colour of a feature by the source of its height, and the legend's rows [text, colour]. */
function bySource(attributes) {
  const counts = new Map();
  const colorOf = (feature) => {
    const source = attributes.value(feature, "height_source");
    return source === null ? null : (HEIGHT_SOURCES[source] || OTHER_SOURCE)[1];
  };
  for (const feature of attributes.rows.keys()) {
    const source = attributes.value(feature, "height_source");
    if (source === null || attributes.layer(feature) === "building_parts") continue;
    const meaning = HEIGHT_SOURCES[source] || OTHER_SOURCE;
    counts.set(meaning[0], { n: (counts.has(meaning[0]) ? counts.get(meaning[0]).n : 0) + 1, rgb: meaning[1] });
  }
  const order = [...Object.values(HEIGHT_SOURCES), OTHER_SOURCE].map(([text]) => text);
  const rows = [...counts].sort(([a], [b]) => order.indexOf(a) - order.indexOf(b)).map(([text, { n, rgb }]) => [`${text} (${n})`, rgb]);
  return { colorOf, rows: [...rows, ["no height of its own", null]] };
}

/** The same by what is guessed of a building's look. */
function byLook(attributes) {
  const kinds = [["walls and roof mapped", [46, 150, 84]], ["walls or roof guessed", [242, 158, 44]], ["walls and roof guessed", [226, 88, 34]]];
  const counts = [0, 0, 0];
  const kindOf = (feature) => ["wall_look_source", "roofing_source"].filter((column) => attributes.value(feature, column) !== null).length;
  for (const feature of attributes.rows.keys()) if (attributes.layer(feature) === "buildings") counts[kindOf(feature)]++;
  const colorOf = (feature) => (attributes.layer(feature) === "buildings" ? kinds[kindOf(feature)][1] : null);
  return { colorOf, rows: [...kinds.map(([text, rgb], k) => [`${text} (${counts[k]})`, rgb]), ["windows are drawn, not mapped", null]] };
}

/** The same by the standard deviation of the height. */
function bySigma(attributes) {
  const colorOf = (feature) => {
    const sigma = attributes.value(feature, "height_sigma");
    return sigma === null ? null : SIGMAS.find(([limit]) => sigma <= limit)[1];
  };
  const rows = SIGMAS.map(([limit, rgb], k) => [Number.isFinite(limit) ? `up to ${limit} m` : `over ${SIGMAS[k - 1][0]} m`, rgb]);
  return { colorOf, rows: [...rows, ["not known", null]] };
}

/** Codes of faces and copies that there are, as the legend's rows. */
function byCode(table, codes) {
  return [...codes].sort((a, b) => a - b).map((code) => [words((table[code] || ["unknown"])[0]), (table[code] || [0, [128, 128, 128]])[1]]);
}

function showLegend(element, rows) {
  element.replaceChildren(...rows.map(([text, rgb]) => {
    const dot = make("span", [], { className: "dot" });
    dot.style.background = toHex(rgb || [172, 176, 180]);
    return make("li", [dot, text]);
  }));
}

/** Features of an OSM id (way/123, w123, 123 or its address) or with a name: at most `most` of [feature, title]. */
function search(attributes, boxes, text, most = 12) {
  const asked = text.trim().toLowerCase();
  if (!asked) return [];
  const id = asked.match(/(?:^|\/)(?:(n|w|r)(?:ode|ay|elation)?)?[/ ]?(\d+)$/);
  const kind = id && { n: "node", w: "way", r: "relation" }[id[1]];
  const found = new Map();
  for (const feature of attributes.rows.keys()) {
    const ids = attributes.ids(feature);
    const name = attributes.value(feature, "name");
    const hit = id
      ? ids.find((own) => (kind ? own === `${kind}/${id[2]}` : own.endsWith(`/${id[2]}`)))
      : name && name.toLowerCase().includes(asked) && (ids[0] || name);
    const title = hit && [name, hit, words(attributes.layer(feature))].filter(Boolean).join(" · ");
    if (!hit || found.has(title) || !boxes.has(attributes.seen(feature))) continue;
    found.set(title, attributes.seen(feature));
    if (found.size === most) break;
  }
  return [...found].map(([title, feature]) => [feature, title]);
}
