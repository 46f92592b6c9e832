// Compressed bytes in elements of the page.

/** The bytes of base64 text. */
function bytesOf(base64) {
  const text = atob(base64);
  const bytes = new Uint8Array(text.length);
  for (let k = 0; k < bytes.length; k++) bytes[k] = text.charCodeAt(k);
  return bytes;
}

/** Inflated bytes (gzip). */
function inflated(bytes) {
  return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
}

/** The bytes of an element of the page, which is removed. */
function takenOf(id) {
  const element = document.getElementById(id);
  const bytes = bytesOf(element.textContent);
  element.remove();
  return bytes;
}

/** The inflated bytes of an element of the page, which is removed. */
function blobOf(id) {
  return inflated(takenOf(id));
}
