// Main program: frames and their cache, playing, events, and the loop that redraws after changes.

const RATES = [0.1, 0.25, 0.5, 1, 2, 5, 10];
const KEPT_RETURNS = 6e6; // of decoded sweeps, beside those that are drawn
const NEAR_PIXELS = 8; // of a click to a return
const BEHIND = { distance: 45, tilt: 0.5 };

/** Where the bytes of frames come from: elements of the page, or its server. */
function sourceOf(head) {
  if (head.served) {
    const ask = async (path) => {
      const answer = await fetch(path);
      if (!answer.ok) throw new Error(`The server has no ${path}: ${await answer.text()}`);
      return new Uint8Array(await answer.arrayBuffer());
    };
    return { sweep: (scanner, k) => ask(`sweep/${scanner}/${k}`), image: (camera, kind, k) => ask(`image/${camera}/${kind}/${k}`) };
  }
  const element = async (id) => bytesOf($(id).textContent);
  return { sweep: (scanner, k) => element(`sweep-${scanner}-${k}`), image: (camera, kind, k) => element(`image-${camera}-${kind}-${k}`) };
}

/** Decoded sweeps, the last used ones. */
class Sweeps {
  constructor(view) {
    this.view = view;
    this.kept = new Map(); // scanner and row -> promise of the sweep; the longest unused first
  }

  /** The sweep of a scanner in a frame. */
  get(scanner, frame) {
    const { source, slots, head, renderer } = this.view;
    const row = head.scanners[scanner].index[frame], key = `${scanner}-${row}`;
    const found = this.kept.get(key) || source.sweep(scanner, row).then(inflated).then((buffer) => {
      const sweep = { ...readSweep(buffer, slots[scanner], head.steps), slots: slots[scanner], far: head.scanners[scanner].far };
      renderer.load(sweep);
      return sweep;
    });
    this.kept.delete(key);
    this.kept.set(key, found);
    return found;
  }

  /** Forget sweeps beyond the limit; those that are drawn stay. */
  async trim(drawn) {
    let sum = 0;
    for (const [key, promise] of [...this.kept].reverse()) {
      const sweep = await promise;
      if (drawn.includes(sweep)) continue;
      sum += sweep.count;
      if (sum > KEPT_RETURNS && this.kept.delete(key)) this.view.renderer.drop(sweep);
    }
  }
}

async function start() {
  const head = readHead();
  const renderer = new Renderer($("canvas"), head);
  const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
  const far = Math.max(...head.scanners.map((scanner) => scanner.far));
  for (const point of head.position)
    for (const axis of [0, 1, 2]) {
      low[axis] = Math.min(low[axis], point[axis] - 2 * far);
      high[axis] = Math.max(high[axis], point[axis] + 2 * far);
    }
  const camera = new Camera(low, high);
  const view = { head, renderer, camera, source: sourceOf(head), dirty: true, frame: -1, playing: false, rate: 1, shown: [] };
  view.extent = Math.max(...[0, 1].map((axis) => Math.max(...head.path.map((p) => p[axis])) - Math.min(...head.path.map((p) => p[axis]))));
  view.slots = (await Promise.all(head.scanners.map((_, k) => blobOf(`slots-${k}`)))).map((buffer) => readSlots(buffer, head.steps.table));
  view.sweeps = new Sweeps(view);
  figures(view);
  fill(view);
  choose(view);
  listen(view);
  behind(view, 0);
  await show(view, 0);
  fromAddress(view);
  loop(view);
  $("message").hidden = true;
  if (window.innerWidth <= 640) $("controls").open = false;
  // For tests and the browser's console.
  window.lidar = {
    view, camera, head,
    show: (frame) => show(view, frame), play: (on) => play(view, on),
    color: (mode) => color(view, mode), scan: (name) => scan(view, name), pick: (x, y) => under(view, x, y),
    points: () => ({ ...Object.fromEntries(COLUMNS.map((name) => [name, [...view.sweep[name]]])), xyz: [...view.sweep.xyz] }),
    placed: (rows) => rows.map((k) => placed(view.sweep, k)),
  };
  document.documentElement.dataset.ready = "yes";
}

/** Options of the lists, and ends of the timeline. */
function fill({ head }) {
  $("color").append(...Object.entries(COLORINGS).map(([value, { title }]) => make("option", title, { value })));
  $("scanner").append(...head.scanners.map(({ name }, k) => make("option", name, { value: k })), make("option", "all", { value: "all" }));
  $("scanner").parentElement.hidden = head.scanners.length === 1;
  $("rate").append(...RATES.map((rate) => make("option", `${rate}×`, { value: rate, selected: rate === 1 })));
  $("time").max = head.numbers.length - 1;
}

/** Which scanners are drawn; the range image, the legend and clicks are of the last one, which is the first of all. */
function choose(view) {
  const { value } = $("scanner");
  view.drawn = value === "all" ? view.head.scanners.map((_, k) => k).reverse() : [Number(value)];
}

/** Draw the scanner of a name, or all. */
function scan(view, name) {
  const chosen = [...$("scanner").options].find((option) => option.textContent === name);
  if (!chosen) return Promise.resolve();
  $("scanner").value = chosen.value;
  choose(view);
  tell(view, null);
  return show(view, view.wanted);
}

/** Show a frame, and with it those before it that are drawn together. */
async function show(view, wanted) {
  const { head, camera } = view;
  const frame = Math.min(head.numbers.length - 1, Math.max(0, Math.round(wanted)));
  const first = Math.max(0, frame - Number($("sweeps").value) + 1);
  view.wanted = frame;
  const { drawn } = view;
  const frames = Array.from({ length: frame - first + 1 }, (_, k) => first + k);
  const found = await Promise.all(frames.flatMap((k) => drawn.map((scanner) => view.sweeps.get(scanner, k))));
  if (view.wanted !== frame || view.drawn !== drawn) return; // something else was asked for meanwhile
  const shown = [...new Set(found)];
  const now = [...new Set(found.slice(-drawn.length))].reduce((sum, { count }) => sum + count, 0);
  if (view.frame >= 0 && $("follow").checked) {
    const [from, to] = [view.frame, frame];
    camera.target = camera.target.map((v, k) => v + head.position[to][k] - head.position[from][k]);
    // Turn about the vehicle, with its heading.
    const turn = head.heading[to] - head.heading[from], [c, s] = [Math.cos(turn), Math.sin(turn)];
    const [x, y] = [0, 1].map((k) => camera.target[k] - head.position[to][k]);
    camera.target[0] = head.position[to][0] + c * x - s * y;
    camera.target[1] = head.position[to][1] + s * x + c * y;
    camera.azimuth -= turn;
  }
  const changed = view.frame !== frame;
  Object.assign(view, { frame, shown, sweep: shown[shown.length - 1], ground: head.position[frame][2], dirty: true });
  $("time").value = frame;
  const at = (head.time_ns[frame] - head.time_ns[0]) / 1e9;
  $("clock").textContent = `frame ${head.numbers[frame]}   ${at.toFixed(2)} s   ${(3.6 * head.speed[frame]).toFixed(1)} km/h   ${now} returns`;
  if (changed) tell(view, null);
  legend(view);
  scanImage(view);
  plan(view);
  graph(view);
  await Promise.all([pictures(view, frame), view.sweeps.trim(shown)]);
}

/** The camera behind the vehicle. */
function behind(view, frame) {
  view.camera.lookAt(view.head.position[frame], BEHIND.distance);
  view.camera.tilt = BEHIND.tilt;
  view.camera.azimuth = Math.PI / 2 - view.head.heading[frame];
  view.dirty = true;
}

function play(view, on) {
  view.playing = on;
  view.clock = null;
  $("play").textContent = on ? "Pause" : "Play";
  if (on && view.frame === view.head.numbers.length - 1) show(view, 0).catch(fail);
}

/** The frame that follows after some milliseconds; the same one while it lasts. */
function advance(view, now) {
  const { head, frame, rate } = view;
  if (view.clock === null || view.busy || view.clock.frame !== frame) {
    view.clock = { frame, since: now };
    return;
  }
  const wanted = head.time_ns[frame] + (now - view.clock.since) * 1e6 * rate;
  let next = frame;
  while (next + 1 < head.numbers.length && head.time_ns[next + 1] <= wanted) next += 1;
  if (next === frame) {
    if (frame === head.numbers.length - 1) play(view, false);
    return;
  }
  const due = now - (wanted - head.time_ns[next]) / 1e6 / rate;
  view.busy = true;
  show(view, next).then(() => {
    // Time that decoding took beyond a quarter of a second is not made up by leaving frames out.
    if (view.clock) view.clock = { frame: next, since: Math.max(due, performance.now() - 250) };
    if (next + 1 < head.numbers.length) for (const scanner of view.drawn) view.sweeps.get(scanner, next + 1).catch(fail);
  }).catch(fail).finally(() => { view.busy = false; });
}

/** Draw whenever something has changed. */
function loop(view) {
  const step = (now) => {
    if (view.playing) advance(view, now);
    if (view.dirty) {
      view.dirty = false;
      const lines = $("boxes").checked ? boxLines(view.sweep.boxes, view.head.classes) : [];
      const path = view.head.position.map(([x, y, z]) => [x, y, z + 0.1]);
      for (let k = 1; k < path.length; k++) lines.push([path[k - 1], path[k], [0.88, 0.63, 0.19]]);
      view.renderer.render(view.camera, view.shown, lines, view);
    }
    requestAnimationFrame(step);
  };
  new ResizeObserver(() => {
    view.dirty = true;
    graph(view);
  }).observe($("canvas"));
  requestAnimationFrame(step);
}

function color(view, mode) {
  if (!(mode in COLORINGS)) return;
  $("color").value = mode;
  view.renderer.mode = Object.keys(COLORINGS).indexOf(mode);
  legend(view);
  scanImage(view);
  view.dirty = true;
}

/** The return nearest to a point of the canvas: its row, its place, and that relative to the target; or null. */
function under(view, x, y) {
  const { camera, sweep } = view;
  const { clientWidth: width, clientHeight: height } = $("canvas");
  const m = camera.matrix(width / height);
  let best = null, least = NEAR_PIXELS, nearest = Infinity;
  for (let k = 0; k < sweep.count; k++) {
    const point = placed(sweep, k), [a, b, c] = point.map((v, axis) => v - camera.target[axis]);
    const w = m[3] * a + m[7] * b + m[11] * c + m[15];
    if (w <= 0) continue;
    const px = ((m[0] * a + m[4] * b + m[8] * c + m[12]) / w + 1) * (width / 2);
    const py = (1 - (m[1] * a + m[5] * b + m[9] * c + m[13]) / w) * (height / 2);
    const away = Math.round(Math.hypot(px - x, py - y));
    if (away > least || (away === least && w >= nearest)) continue;
    [best, least, nearest] = [{ row: k, point, relative: [a, b, c] }, away, w];
  }
  return best;
}

/** #frame=12&color=height&scanner=all&view=x,y,z,distance,azimuth,tilt, any of them. */
function fromAddress(view) {
  const given = new URLSearchParams(location.hash.slice(1));
  if (given.has("color")) color(view, given.get("color"));
  if (given.has("scanner")) scan(view, given.get("scanner")).catch(fail);
  const row = view.head.numbers.indexOf(Number(given.get("frame")));
  if (given.has("frame") && row >= 0) show(view, row).catch(fail);
  if (given.has("view")) view.camera.fromText(given.get("view"));
  view.dirty = true;
}

function listen(view) {
  const { renderer, camera, head } = view;
  const canvas = $("canvas");
  const moving = () => { view.dirty = true; };
  const go = (to) => {
    play(view, false);
    show(view, to).catch(fail);
  };
  const step = (by) => go(view.wanted + by); // from the frame last asked for, which may still be decoded
  const toggle = (id) => $(id).click();
  const rate = (by) => {
    const next = $("rate").selectedIndex + by;
    if (next < 0 || next >= RATES.length) return;
    $("rate").selectedIndex = next;
    view.rate = RATES[next];
  };
  const together = (by) => {
    $("sweeps").value = Math.min(100, Math.max(1, Number($("sweeps").value) + by));
    show(view, view.wanted).catch(fail);
  };

  gestures(canvas, camera, {
    moving,
    under: (x, y) => under(view, x, y),
    hover: () => {},
    click: (x, y) => {
      const hit = under(view, x, y);
      tell(view, hit && hit.row);
    },
  });
  onKeys(({ tagName, type }) => tagName === "SELECT" || type === "number", ({ shiftKey }) => {
    const ten = shiftKey ? 10 : 1;
    return {
      " ": () => play(view, !view.playing), ArrowLeft: () => step(-ten), ArrowRight: () => step(ten),
      Home: () => step(-Infinity), End: () => step(Infinity),
      "[": () => rate(-1), "]": () => rate(1), "<": () => together(-1), ">": () => together(1),
      c: () => color(view, Object.keys(COLORINGS)[(renderer.mode + 1) % Object.keys(COLORINGS).length]),
      b: () => toggle("boxes"), v: () => toggle("follow"), h: () => behind(view, view.frame),
      ...turningKeys(camera), Escape: () => tell(view, null),
    };
  }, moving);

  $("play").onclick = () => play(view, !view.playing);
  $("back").onclick = () => step(-1);
  $("ahead").onclick = () => step(1);
  $("rate").onchange = () => { view.rate = Number($("rate").value); };
  $("time").oninput = () => go(Number($("time").value));
  $("graph").onclick = (event) => {
    const share = (event.offsetX - 8) / Math.max(1, $("graph").clientWidth - 16);
    go(share * (head.numbers.length - 1));
  };
  $("scanner").onchange = () => scan(view, $("scanner").selectedOptions[0].textContent).catch(fail);
  $("color").onchange = () => color(view, $("color").value);
  $("sweeps").onchange = () => together(0);
  $("size").oninput = () => {
    renderer.size = Number($("size").value);
    moving();
  };
  $("boxes").onchange = moving;
}

start().catch(fail);
