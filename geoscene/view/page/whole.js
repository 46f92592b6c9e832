// Loading of a page that holds the whole scene.

/** Put all tiles on the graphics card, from the middle outwards, and learn about the features. */
async function load(view) {
  const { head, renderer } = view;
  Object.assign(view, { bytes: 0, settled: () => !view.dirty });
  await learn(view, takenOf("attributes"), takenOf("boxes"));
  let shown = performance.now(), pause = 250;
  for (const [k, told] of head.tiles.entries()) {
    const entry = admit(view, told, await blobOf(`tile-${k}`));
    renderer.tiles.push({ number: k, ...entry });
    view.bytes += entry.bytes;
    renderer.stale = true;
    if (performance.now() - shown < pause) continue;
    $("message").textContent = `Reading the scene … ${k + 1} of ${head.tiles.length} tiles`;
    view.dirty = true;
    const waited = performance.now();
    await new Promise((done) => {
      requestAnimationFrame(() => requestAnimationFrame(done));
      setTimeout(done, 3000); // hidden pages get no animation frames
    });
    shown = performance.now();
    pause = Math.max(250, 8 * (shown - waited)); // on a slow card, loading takes precedence over drawing
  }
}
