// Panels beside the point cloud: images, range image, plan, speed, legend, what is known of a return.

/** Colours by: title, and marks below the ramp. */
const COLORINGS = {
  class: { title: "class" },
  height: { title: "height above the vehicle's ground", ends: ["−1 m", "10 m"] },
  intensity: { title: "intensity", ends: ["0", "100"] },
  instance: { title: "instance" },
  time: { title: "time in the sweep", ends: ["first", "last"] },
  echo: { title: "echo" },
  origin: { title: "origin" },
  range: { title: "range" },
  ring: { title: "channel", ends: ["lowest", "highest"] },
};

function legend(view) {
  const { head, sweep } = view;
  const mode = Object.keys(COLORINGS)[view.renderer.mode];
  const of = (column, name, color) => [...new Set(sweep[column])].sort((a, b) => a - b).map((code) => [color(code), name(code), code, column]);
  const rows = {
    class: () => of("label", (c) => words(head.classes[c][0]), (c) => head.classes[c][1]),
    echo: () => of("echo", (c) => `echo ${c}`, (c) => head.distinct[c % 7]),
    origin: () => of("origin", (c) => words(head.origins[c]), (c) => (c ? head.distinct[(c - 1) % 7] : [128, 128, 128])),
  }[mode];
  const ends = mode === "range" ? ["0", `${sweep.far / 4} m`, `${sweep.far} m`] : COLORINGS[mode].ends;
  const items = [];
  if (rows) {
    for (const [color, text, code, column] of rows()) {
      const dot = make("span", [], { className: "dot" });
      dot.style.background = toHex(color);
      items.push(make("li", [dot, `${text} (${sweep[column].filter((c) => c === code).length})`]));
    }
  } else if (ends) {
    const bar = make("div", [], { className: "ramp" });
    bar.style.background = `linear-gradient(90deg, ${head.ramp.filter((_, k) => k % 15 === 0).map(toHex).join(",")})`;
    items.push(make("li", [bar, make("div", ends.map((end) => make("span", end)), { className: "ends" })]));
  }
  if (mode === "origin" && !head.truth) items.push(make("li", "No stage acted: all returns are of surfaces."));
  $("legend").replaceChildren(...items);
}

/** Colour of a return in the range image, by the mode of the point cloud. */
function colorOf(view, k) {
  const { head, sweep, ground } = view;
  const ramp = (share) => head.ramp[Math.floor(Math.min(1, Math.max(0, share)) * 255)];
  switch (Object.keys(COLORINGS)[view.renderer.mode]) {
    case "class": return head.classes[sweep.label[k]][1];
    case "height": return ramp((placed(sweep, k)[2] - ground + 1) / 11);
    case "intensity": return ramp(sweep.intensity[k] / 100);
    case "time": return ramp(sweep.time[k] / sweep.poses.span);
    case "echo": return head.distinct[sweep.echo[k] % 7];
    case "origin": return sweep.origin[k] ? head.distinct[(sweep.origin[k] - 1) % 7] : [128, 128, 128];
    case "instance": return sweep.instance[k] < 0 ? [115, 115, 115] : hueOf(sweep.instance[k]);
    case "ring": return ramp(sweep.ring[k] / Math.max(1, sweep.slots.rings - 1));
    default: return ramp(Math.sqrt(sweep.range[k] / sweep.far));
  }
}

/** The colour that the shader gives an instance. */
function hueOf(instance) {
  const hue = ((Math.imul(instance, 2654435761) >>> 8) / 16777216) * 6;
  return [Math.abs(hue - 3) - 1, 2 - Math.abs(hue - 2), 2 - Math.abs(hue - 4)].map((v) => 255 * (0.35 + 0.65 * Math.min(1, Math.max(0, v))));
}

/** Rows are channels, the highest on top; columns azimuths, from left to right; the last return drawn is the first. */
function scanImage(view) {
  const { sweep } = view, { rings, columns, azimuths } = sweep.slots;
  const canvas = $("scan");
  const width = Math.min(columns, 720), height = Math.min(rings, 256);
  if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
  const context = canvas.getContext("2d");
  const image = context.createImageData(width, height);
  const [low, high] = azimuths;
  for (let k = sweep.count - 1; k >= 0; k--) {
    const azimuth = Math.atan2(sweep.xyz[3 * k + 1], sweep.xyz[3 * k]);
    const x = Math.min(width - 1, Math.max(0, Math.floor(((high - azimuth) / (high - low)) * width)));
    const y = height - 1 - Math.floor((sweep.ring[k] / rings) * height);
    if (y >= 0) image.data.set([...colorOf(view, k), 255], 4 * (y * width + x));
  }
  context.putImageData(image, 0, 0);
}

/** Figures for the images of cameras. */
function figures({ head }) {
  $("pictures").replaceChildren(...head.cameras.flatMap(({ name, kinds }, number) => kinds.map((kind) => {
    const canvas = make("canvas", [], { id: `picture-${number}-${kind}`, width: 16, height: 9 });
    return make("figure", [canvas, make("figcaption", `${name}: ${kind === "rgb" ? "colour" : "depth, violet 80 m to yellow 0"}`)]);
  })));
}

/** Draw the images of a frame. */
async function pictures(view, frame) {
  for (const [number, { kinds, index }] of view.head.cameras.entries())
    for (const kind of kinds) {
      const bytes = await view.source.image(number, kind, index[frame]);
      const image = await createImageBitmap(new Blob([bytes], { type: "image/jpeg" }));
      if (view.frame !== frame) return; // another frame is shown by now
      const canvas = $(`picture-${number}-${kind}`);
      [canvas.width, canvas.height] = [image.width, image.height];
      canvas.getContext("2d").drawImage(image, 0, 0);
      canvas.dataset.index = index[frame];
    }
}

/** Path, roads, road users and vehicle on a plan around the vehicle. */
function plan(view) {
  const { head, frame, sweep } = view;
  const canvas = $("plan"), context = canvas.getContext("2d");
  const { width, height } = canvas;
  const [x, y] = head.position[frame];
  const reach = Math.max(60, Math.min(400, view.extent / 2 + 20));
  const scale = Math.min(width, height) / (2 * reach);
  const at = ([px, py]) => [width / 2 + (px - x) * scale, height / 2 - (py - y) * scale];
  context.fillStyle = "#12151c";
  context.fillRect(0, 0, width, height);
  const line = (points, color, thick) => {
    context.strokeStyle = color;
    context.lineWidth = thick;
    context.beginPath();
    points.forEach((point, k) => (k ? context.lineTo(...at(point)) : context.moveTo(...at(point))));
    context.stroke();
  };
  for (const road of head.roads) line(road, "#4a5364", Math.max(1.5, 6 * scale));
  line(head.path, "#e0a030", 2);
  for (const box of sweep.boxes) {
    const corners = cornersOf(box);
    context.fillStyle = toHex(head.classes[box.class][1]);
    context.beginPath();
    [0, 1, 5, 4].forEach((k, n) => (n ? context.lineTo(...at(corners[k])) : context.moveTo(...at(corners[k]))));
    context.fill();
    const [bx, by] = at([box.x, box.y]);
    context.fillRect(bx - 1, by - 1, 2, 2);
  }
  context.save();
  context.translate(width / 2, height / 2);
  context.rotate(-head.heading[frame]);
  context.fillStyle = "#ffffff";
  context.beginPath();
  for (const point of [[9, 0], [-6, 5], [-3, 0], [-6, -5]]) context.lineTo(...point);
  context.fill();
  context.restore();
  context.fillStyle = "#ffffff";
  const metres = [500, 200, 100, 50, 20].find((length) => length * scale < width / 3) || 10;
  context.fillRect(8, height - 10, metres * scale, 2);
  context.font = "11px system-ui";
  context.fillText(`${metres} m`, 8, height - 14);
}

/** Speed over time, and a mark at the frame that is shown. */
function graph(view) {
  const { head, frame } = view;
  const canvas = $("graph"), context = canvas.getContext("2d");
  const ratio = Math.min(window.devicePixelRatio || 1, 2);
  const [width, height] = [Math.round(canvas.clientWidth * ratio), Math.round(canvas.clientHeight * ratio)];
  [canvas.width, canvas.height] = [width, height];
  const top = Math.max(1, ...head.speed) * 1.1, last = Math.max(1, head.speed.length - 1);
  const place = (k) => (k / last) * (width - 16 * ratio) + 8 * ratio; // as the handle of a slider moves
  context.strokeStyle = "#6fb1ff";
  context.lineWidth = 1.5 * ratio;
  context.beginPath();
  head.speed.forEach((speed, k) => context.lineTo(place(k), height - 2 - (speed / top) * (height - 4)));
  context.stroke();
  context.fillStyle = "#ffffff";
  context.fillRect(place(frame) - ratio / 2, 0, ratio, height);
  const text = `speed, up to ${(3.6 * Math.max(...head.speed)).toFixed(0)} km/h`;
  context.font = `${11 * ratio}px system-ui`;
  context.fillStyle = "#1c2029";
  context.fillRect(0, height - 13 * ratio, context.measureText(text).width + 8 * ratio, 13 * ratio);
  context.fillStyle = "#9aa4b2";
  context.fillText(text, 4 * ratio, height - 3 * ratio);
}

/** What is known of a return of the current sweep. */
function tell(view, k) {
  const { head, sweep } = view;
  view.renderer.picked = k === null ? -1 : k;
  view.dirty = true;
  $("told").hidden = k === null;
  if (k === null) return;
  const box = sweep.boxes.find(({ instance }) => instance === sweep.instance[k]);
  const rows = {
    class: words(head.classes[sweep.label[k]][0]), instance: sweep.instance[k] < 0 ? "none" : sweep.instance[k],
    "road user": box ? `${box.id}, ${(3.6 * Math.hypot(box.vx, box.vy)).toFixed(1)} km/h, ${box.points} returns` : "",
    range: `${sweep.range[k].toFixed(3)} m`, intensity: sweep.intensity[k], channel: sweep.ring[k], column: sweep.column[k],
    echo: sweep.echo[k] || "", origin: head.truth ? words(head.origins[sweep.origin[k]]) : "",
    time: `${(sweep.time[k] / 1e6).toFixed(3)} ms after the start`,
    scene: placed(sweep, k).map((v) => v.toFixed(2)).join(", "),
  };
  $("told").replaceChildren(make("table", Object.entries(rows).filter(([, value]) => value !== "")
    .map(([name, value]) => make("tr", [make("td", name), make("td", String(value))]))));
}
