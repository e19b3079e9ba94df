// Hands on a shape: drag, wheel, pinch and keys.

function handled(canvas, look, turn) {
  const held = new Map();
  let apart = 0;

  function rotate(across, down) {
    look.azimuth = (look.azimuth - across + 360) % 360;
    look.elevation = Math.min(90, Math.max(-90, look.elevation + down));
    turn();
  }
  function zoom(factor) {
    look.zoom = Math.min(6, Math.max(0.6, look.zoom * factor));
    turn();
  }

  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    held.set(event.pointerId, [event.clientX, event.clientY]);
    apart = 0;
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = held.get(event.pointerId);
    if (!before) return;
    held.set(event.pointerId, [event.clientX, event.clientY]);
    if (held.size === 1) return rotate(0.5 * (event.clientX - before[0]), 0.5 * (event.clientY - before[1]));
    const [[ax, ay], [bx, by]] = [...held.values()];
    const now = Math.hypot(ax - bx, ay - by);
    if (apart) zoom(now / apart);
    apart = now;
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => held.delete(event.pointerId));
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(Math.exp(-0.0015 * event.deltaY));
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const turns = { ArrowLeft: [-12, 0], ArrowRight: [12, 0], ArrowUp: [0, -12], ArrowDown: [0, 12] };
    const zooms = { "+": 1.25, "=": 1.25, "-": 0.8, "−": 0.8 };
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (turns[event.key]) rotate(...turns[event.key]);
    else if (zooms[event.key]) zoom(zooms[event.key]);
    else if (event.key === "0") {
      Object.assign(look, START);
      turn();
    } else return;
    event.preventDefault();
  });
}
