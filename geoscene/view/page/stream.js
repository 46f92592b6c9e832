// Loading of a page in parts: nodes of a tree, each in a file of its own; see geoscene.view.streamed.

const COARSEST = 4; // pixels of a node's cells, by which vertices move at most; on average a third of it
const AT_ONCE = 8; // files that are loaded at the same time
const MOST_BYTES = 768e6; // on the graphics card; nodes that are not shown are given up beyond

/** Learn about the features, load the coarsest nodes, and from then on what each view wants. */
async function load(view) {
  const { head } = view;
  const nodes = head.nodes.map(([x, y, z, X, Y, Z, error, ...children]) => ({ low: [x, y, z], high: [X, Y, Z], error, children }));
  Object.assign(view, { nodes, loading: new Set(), bytes: 0, turn: 0 });
  view.settled = () => !view.dirty && !view.fresh && !view.loading.size && !view.asked;
  const waiting = new Map();
  window.geosceneNode = (number, told, text) => waiting.set(number, [told, text]);
  const fetched = async (number) => {
    await script(`nodes/${number}.js`);
    const [told, text] = waiting.get(number);
    waiting.delete(number);
    const entry = admit(view, told, await inflated(bytesOf(text)));
    nodes[number].entry = { number, coarse: nodes[number].error > 0, ...entry };
    view.bytes += entry.bytes;
  };
  await Promise.all(head.roots.map(fetched));
  view.wanted = () => refine(view, (number) => {
    view.loading.add(number);
    fetched(number).then(() => {
      view.loading.delete(number);
      view.fresh = true;
      view.wanted();
    }).catch(fail);
  });
  view.dirty = true;
  const text = new Promise((done) => { window.geosceneAttributes = (...parts) => done(parts); });
  await script("attributes.js");
  await learn(view, ...(await text).map(bytesOf));
}

/** Run a file beside the page; a page from disk may load scripts, but not read files. */
function script(path) {
  return new Promise((done, failed) => {
    const element = make("script", [], { src: path });
    element.onload = done;
    element.onerror = () => failed(new Error(`${path} cannot be loaded; keep the folder of the page whole.`));
    document.head.append(element);
  }).then((event) => event.target.remove());
}

/**
 * Show the coarsest nodes that are fine enough for the view, and ask for those that lack: the most needed first.
 *
 * A node is replaced by its children only when all of them are there, so that nothing is missing meanwhile. What is
 * behind the camera is chosen by its distance alone: a turn shows it at once, and it casts shadows.
 */
function refine(view, ask) {
  const { head, nodes, renderer, camera } = view;
  const { canvas } = renderer, eye = camera.eye(), target = camera.target;
  const matrix = camera.matrix(canvas.clientWidth / canvas.clientHeight);
  const pixel = camera.pixel(canvas.clientHeight) / camera.distance; // metres at one metre
  const shown = [], lacking = [];
  view.turn++;
  const visit = (number) => {
    const node = nodes[number];
    node.turn = view.turn;
    const away = Math.hypot(...eye.map((v, k) => v - Math.min(node.high[k], Math.max(node.low[k], v))));
    const pixels = node.error / (pixel * Math.max(1, away));
    if (pixels > COARSEST) {
      const without = node.children.filter((child) => !nodes[child].entry);
      if (!without.length) {
        node.children.forEach(visit);
        return;
      }
      const [low, high] = [node.low, node.high].map((corner) => corner.map((v, k) => v - target[k]));
      const need = pixels * (boxSeen(matrix, low, high) ? 1 : 0.1);
      node.children.forEach((child) => { nodes[child].turn = view.turn; });
      lacking.push(...without.map((child) => [need, child]));
    }
    shown.push(node.entry);
  };
  head.roots.forEach(visit);
  if (shown.length !== renderer.tiles.length || shown.some((entry, k) => entry !== renderer.tiles[k])) {
    renderer.tiles = shown;
    renderer.stale = true;
  }
  view.asked = lacking.length;
  lacking.sort((a, b) => b[0] - a[0]);
  for (const [, child] of lacking) {
    if (view.loading.size >= AT_ONCE) break;
    if (!view.loading.has(child)) ask(child);
  }
  forget(view);
}

/** Give up the nodes that were not needed for the longest time, while there are too many. */
function forget(view) {
  if (view.bytes <= MOST_BYTES) return;
  const idle = view.nodes.filter(({ entry, turn }) => entry && turn !== view.turn).sort((a, b) => a.turn - b.turn);
  for (const node of idle) {
    if (view.bytes <= MOST_BYTES) return;
    view.bytes -= node.entry.bytes;
    view.renderer.remove(node.entry);
    node.entry = null;
  }
}
