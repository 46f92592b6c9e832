// Tools of both pages: elements, texts, the header, the graphics context, keys, failures.

const $ = (id) => document.getElementById(id);

/** An element with text or children, and properties. */
function make(tag, content = [], set = {}) {
  const element = Object.assign(document.createElement(tag), set);
  element.append(...[content].flat());
  return element;
}

const words = (name) => name.replaceAll("_", " ");
const toHex = (rgb) => `rgb(${rgb.join(",")})`;

/** The page's header. */
function readHead() {
  if (!("DecompressionStream" in window)) throw new Error("This browser is too old: it cannot decompress the page's data.");
  return JSON.parse($("head").textContent);
}

/** The WebGL 2 context of a canvas. */
function contextOf(canvas) {
  const gl = canvas.getContext("webgl2", { antialias: true });
  if (!gl) throw new Error("This browser does not support WebGL 2, which the page needs.");
  canvas.addEventListener("webglcontextlost", () => fail(new Error("The graphics context was lost; reload the page.")));
  return gl;
}

/** Run the action of each key pressed, of `actionsOf(event)` by key, then `after`; not where `types(element)` is true. */
function onKeys(types, actionsOf, after) {
  document.addEventListener("keydown", (event) => {
    if (types(event.target) || event.ctrlKey || event.metaKey || event.altKey) return;
    const action = actionsOf(event)[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (!action) return;
    event.preventDefault();
    action();
    after();
  });
}

/** Show an error; a page that has not been shown yet has failed. */
function fail(error) {
  $("message").hidden = false;
  $("message").textContent = error.message;
  if (document.documentElement.dataset.ready !== "yes") document.documentElement.dataset.ready = "failed";
}
