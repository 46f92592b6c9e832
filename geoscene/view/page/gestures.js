// Mouse, touch and keys that move a camera.

/**
 * Turn, move and zoom a camera by pointers over a canvas.
 *
 * moving: called after each movement. under(x, y): what lies under a point of the canvas, with its place as `point`
 * and relative to the camera's target as `relative`, or null. hover(x, y), click(x, y): called for pointers that are
 * not dragged.
 */
function gestures(canvas, camera, { moving, under, hover, click }) {
  const pointers = new Map();
  let moved = 0;
  const place = (event) => [event.offsetX, event.offsetY];
  const settle = () => {
    const hit = under(canvas.clientWidth / 2, canvas.clientHeight / 2);
    if (hit) camera.settle(hit.relative);
  };
  const pan = (dx, dy) => {
    const pixel = camera.pixel(canvas.clientHeight);
    camera.move(-dx * pixel, (dy * pixel) / Math.max(0.2, Math.sin(camera.tilt)));
  };

  canvas.addEventListener("pointerdown", (event) => {
    canvas.focus();
    try {
      canvas.setPointerCapture(event.pointerId);
    } catch {
      // The pointer was released already; its events still arrive over the canvas.
    }
    if (!pointers.size) {
      moved = 0;
      settle();
    }
    pointers.set(event.pointerId, place(event));
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    const [x, y] = place(event);
    if (!before) {
      hover(x, y);
      return;
    }
    const [dx, dy] = [x - before[0], y - before[1]];
    moved += Math.abs(dx) + Math.abs(dy);
    if (pointers.size === 2) {
      const other = [...pointers].find(([id]) => id !== event.pointerId)[1];
      const [ax, ay, bx, by] = [before[0] - other[0], before[1] - other[1], x - other[0], y - other[1]];
      camera.zoom((Math.hypot(ax, ay) || 1) / (Math.hypot(bx, by) || 1));
      camera.turn(Math.atan2(ay, ax) - Math.atan2(by, bx), 0);
      pan(dx / 2, dy / 2);
    } else if (event.shiftKey || event.buttons & 6) pan(dx, dy);
    else camera.turn(dx * 0.006, dy * 0.005);
    pointers.set(event.pointerId, [x, y]);
    if (moved > 4) moving();
  });
  const release = (event) => {
    if (pointers.delete(event.pointerId) && event.type === "pointerup" && moved <= 4 && event.button === 0) click(...place(event));
  };
  canvas.addEventListener("pointerup", release);
  canvas.addEventListener("pointercancel", release);
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("dblclick", (event) => {
    const hit = under(...place(event));
    if (hit) camera.lookAt(hit.point, Math.max(30, camera.distance / 2));
    moving();
  });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    const lines = event.deltaMode === 1 ? 30 : 1;
    const hit = under(...place(event));
    camera.zoom(Math.exp(Math.max(-240, Math.min(240, event.deltaY * lines)) * 0.002), hit ? hit.relative : undefined);
    moving();
  }, { passive: false });
}

/** Actions of keys that rotate and zoom a camera. */
function turningKeys(camera) {
  return {
    q: () => camera.turn(0.1, 0), e: () => camera.turn(-0.1, 0),
    r: () => camera.turn(0, 0.08), f: () => camera.turn(0, -0.08),
    "+": () => camera.zoom(0.85), "=": () => camera.zoom(0.85), "-": () => camera.zoom(1 / 0.85),
    t: () => camera.turn(0, Math.PI),
  };
}
