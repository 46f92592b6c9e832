// Main program: loading, events, and the loop that redraws after changes.

const MODES = { look: 0, material: 1, class: 2, source: 3, sigma: 3, guesses: 3 };

async function start() {
  const head = readHead();
  const shapes = readShapes(head.shapes, await blobOf("shapes"));
  const renderer = new Renderer($("canvas"), head, shapes);
  const camera = new Camera(head.low, head.high);
  camera.whole(head.busy, window.innerWidth / window.innerHeight);
  const used = { material: new Set(), class: new Set() };
  const view = { head, shapes, renderer, camera, used, dirty: true, cursor: null, wanted: () => {} };
  loop(view);
  await load(view);
  $("message").hidden = true;
  if (window.innerWidth <= 640) $("controls").open = false;

  listen(view);
  layers(view);
  color(view, "look");
  fromAddress(view);
  window.addEventListener("hashchange", () => location.hash !== view.address && fromAddress(view));
  // For tests and the browser's console.
  window.geoscene = {
    ready: true,
    pick: (x, y) => renderer.pick(camera, x, y),
    click: (x, y) => click(view, x, y),
    select: (text) => find(view, text),
    color: (mode) => color(view, mode),
    camera, attributes: view.attributes, boxes: view.boxes, head, settled: () => view.settled(),
    first: () => view.first, bytes: () => view.bytes,
    tiles: () => renderer.tiles.map(({ number, told }) => [number, told.ends[told.ends.length - 1]]),
    redraw: () => { view.dirty = true; },
    lonLat: (x, y) => toLonLat(head.lonlat, x, y),
    benchmark: (frames) => {
      const began = performance.now();
      for (let k = 0; k < frames; k++) {
        camera.turn(0.01, 0);
        renderer.render(camera);
        renderer.gl.readPixels(0, 0, 1, 1, renderer.gl.RGBA, renderer.gl.UNSIGNED_BYTE, new Uint8Array(4)); // waits until the frame is drawn
      }
      return (performance.now() - began) / frames;
    },
  };
  document.documentElement.dataset.ready = "yes";
}

/** Put a tile or a node, as its file has it, on the graphics card. */
function admit({ shapes, renderer, used }, told, buffer) {
  const tile = readTile(told, buffer);
  for (const part of [tile, ...new Set(told.runs.map((run) => shapes[run[1]]))]) {
    part.material.forEach((code) => used.material.add(code));
    part.klass.forEach((code) => used.class.add(code));
  }
  return renderer.add(told, tile);
}

/** What is known of the features, from its compressed bytes. */
async function learn(view, attributes, boxes) {
  view.attributes = new Attributes(JSON.parse(new TextDecoder().decode(await inflated(attributes))));
  view.boxes = new Boxes(view.head.features, await inflated(boxes));
}

/** Draw whenever something has changed; what is `fresh` from loading, a few times a second. */
function loop(view) {
  let drawn = 0, pause = 250, timed = true;
  const step = (now) => {
    if (!timed) pause = Math.max(250, 4 * (now - drawn)); // on a slow card, loading takes precedence over drawing
    timed = true;
    if (view.dirty || (view.fresh && now - drawn > pause)) {
      view.dirty = view.fresh = timed = false;
      drawn = now;
      view.wanted();
      view.renderer.render(view.camera);
      if (view.renderer.tiles.length) view.first ??= performance.now();
      footer(view);
    }
    if (view.cursor) {
      cursorText(view, view.cursor);
      view.cursor = null;
    }
    requestAnimationFrame(step);
  };
  new ResizeObserver(() => { view.dirty = true; }).observe($("canvas"));
  requestAnimationFrame(step);
}

/** Scale bar and north arrow. */
function footer({ head, camera, renderer }) {
  const pixel = camera.pixel(renderer.canvas.clientHeight);
  const most = pixel * 120, power = 10 ** Math.floor(Math.log10(most));
  const length = [5, 2, 1].map((k) => k * power).find((metres) => metres <= most);
  $("bar").style.width = `${length / pixel}px`;
  $("length").textContent = length >= 1000 ? `${length / 1000} km` : `${length} m`;
  // True north lies at a grid azimuth of minus the convergence.
  $("compass").style.transform = `rotate(${-camera.azimuth - head.convergence}rad)`;
}

function cursorText({ head, renderer, camera }, [x, y]) {
  const hit = renderer.pick(camera, x, y);
  if (!hit) {
    $("cursor").textContent = "";
    return;
  }
  const [lon, lat] = toLonLat(head.lonlat, hit.point[0], hit.point[1]);
  const [px, py, pz] = hit.point.map(metres);
  $("cursor").textContent = `${lat.toFixed(7)}, ${wrapped(lon).toFixed(7)} (lat, lon)   x ${px}  y ${py}  z ${pz} m`;
  const within = Math.max(head.lonlat.error, 1e-4);
  $("cursor").title = `Latitude and longitude within ${within.toPrecision(2)} m of the projection's (${head.frame}); `
    + `positions to ${(head.step * 500).toFixed(1)} mm an axis; z is ${head.vertical}`;
}

/** Select what lies under a point of the canvas; nothing over the sky. */
function click(view, x, y) {
  const hit = view.renderer.pick(view.camera, x, y);
  select(view, hit ? hit.feature : null, hit);
  return hit;
}

function select(view, feature, hit) {
  const { head, attributes, renderer } = view;
  renderer.selected = feature === null ? -1 : feature;
  renderer.glow = attributes.layer(feature) === "landcover" ? 0.25 : 0.7; // a weaker highlight for large areas
  view.dirty = true;
  const panel = $("panel");
  panel.hidden = feature === null;
  if (feature === null) return;
  const close = make("button", "×", { className: "close", title: "Close" });
  close.onclick = () => select(view, null);
  panel.replaceChildren(close, ...describe(head, attributes, feature, hit));
  panel.dataset.feature = feature;
}

/** Select a feature and look at it. */
function visit(view, feature) {
  const { boxes, camera } = view;
  if (boxes.has(feature)) camera.lookAt(boxes.middle(feature), Math.max(30, 2.5 * boxes.size(feature)));
  select(view, feature);
}

/** Go to the first feature of an OSM id or name; whether there is one. */
function find(view, text) {
  const [first] = search(view.attributes, view.boxes, text);
  if (first) visit(view, first[0]);
  return Boolean(first);
}

function color(view, mode) {
  const { head, attributes, renderer, used } = view;
  if (!(mode in MODES)) return;
  $("color").value = mode;
  renderer.mode = MODES[mode];
  let rows = [];
  if (mode === "material") rows = byCode(head.materials, used.material);
  if (mode === "class") rows = byCode(head.classes, used.class);
  if (MODES[mode] === 3) {
    const key = { source: bySource, sigma: bySigma, guesses: byLook }[mode](attributes);
    renderer.colorFeatures(key.colorOf);
    rows = key.rows;
  }
  showLegend($("legend"), rows);
  view.dirty = true;
}

function layers(view) {
  const { head, renderer } = view;
  for (const group of head.groups) {
    const box = make("input", [], { type: "checkbox", checked: true, id: `layer-${group}` });
    box.onchange = () => {
      if (box.checked) renderer.hidden.delete(group);
      else renderer.hidden.add(group);
      view.dirty = true;
    };
    $("layers").append(make("label", [box, ` ${words(group)}`]));
  }
}

/** #view=…&color=…&off=a,b&shadows=0&guesses=0&select=way/1&pick=x,y, any of them. */
function fromAddress(view) {
  const given = new URLSearchParams(location.hash.slice(1));
  if (given.has("color")) color(view, given.get("color"));
  for (const group of (given.get("off") || "").split(",").filter(Boolean)) {
    const box = $(`layer-${group}`);
    if (box && box.checked) box.click();
  }
  for (const box of ["shadows", "guesses"])
    if (given.has(box) && $(box).checked !== (given.get(box) !== "0")) $(box).click();
  if (given.has("select")) find(view, given.get("select"));
  if (given.has("view")) view.camera.fromText(given.get("view"));
  if (given.has("pick")) click(view, ...given.get("pick").split(",").map(Number));
  view.dirty = true;
}

/** Keep the view in the address, so that a reload or a link shows the same. */
function toAddress(view) {
  clearTimeout(view.timer);
  view.timer = setTimeout(() => {
    const given = new URLSearchParams(location.hash.slice(1));
    given.delete("pick");
    given.delete("select");
    given.set("view", view.camera.toText());
    view.address = `#${decodeURIComponent(given.toString())}`;
    try {
      history.replaceState(null, "", view.address);
    } catch {
      // Some browsers forbid it for pages from disk; the address then does not follow the view.
    }
  }, 400);
}

function listen(view) {
  const { renderer, camera } = view;
  const canvas = $("canvas");
  const moving = () => {
    view.dirty = true;
    toAddress(view);
  };
  gestures(canvas, camera, {
    moving,
    under: (x, y) => renderer.pick(camera, x, y),
    hover: (x, y) => { view.cursor = [x, y]; },
    click: (x, y) => click(view, x, y),
  });

  onKeys(({ tagName }) => /INPUT|SELECT/.test(tagName), () => {
    const far = camera.distance / 20;
    return {
      ArrowLeft: () => camera.move(-far, 0), ArrowRight: () => camera.move(far, 0),
      ArrowUp: () => camera.move(0, far), ArrowDown: () => camera.move(0, -far),
      ...turningKeys(camera), n: () => { camera.azimuth = 0; }, h: () => camera.whole(camera, window.innerWidth / window.innerHeight),
      Escape: () => select(view, null),
    };
  }, moving);

  $("color").onchange = () => color(view, $("color").value);
  $("sun").oninput = () => {
    renderer.sunAzimuth = ($("sun").value * Math.PI) / 180;
    view.dirty = true;
  };
  $("sun").oninput();
  for (const box of ["shadows", "guesses"]) {
    $(box).onchange = () => {
      renderer[box] = $(box).checked;
      view.dirty = true;
    };
    $(box).onchange();
  }
  const list = () => {
    const found = search(view.attributes, view.boxes, $("search").value);
    $("found").replaceChildren(...found.map(([feature, title]) => {
      const item = make("li", title, { tabIndex: 0 });
      item.onclick = () => visit(view, feature);
      item.onkeydown = (event) => event.key === "Enter" && visit(view, feature);
      return item;
    }));
    if (!found.length && $("search").value.trim()) $("found").append(make("p", "Not in this scene."));
  };
  $("search").oninput = list;
  $("search").onkeydown = (event) => event.key === "Enter" && find(view, $("search").value);
}

start().catch(fail);
