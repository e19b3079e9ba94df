// Strips of pictures (examples/turning.py) that turn by dragging, by the arrow keys, and slowly by themselves.
// Markup: <div class="turn" data-strip="gallery/tubes.webp" data-frames="24" data-name="tubes"></div>, with
// data-around="no" for a strip that has two ends, such as laws between two. Strips are named from the site's root.
(() => {
  const root = new URL("..", document.currentScript.src);
  const STEP = 8; // pixels of a drag for the next picture
  const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;

  function set(box, index) {
    const count = Number(box.dataset.frames);
    const around = box.dataset.around !== "no";
    const frame = around ? ((index % count) + count) % count : Math.min(Math.max(index, 0), count - 1);
    box.dataset.frame = frame;
    box.style.backgroundPosition = `${(100 * frame) / (count - 1)}% 0`;
    box.setAttribute("aria-valuenow", frame + 1);
    const share = Math.round((100 * frame) / (count - 1));
    box.setAttribute("aria-valuetext", around ? `${Math.round((360 * frame) / count)} degrees` : `${share} percent`);
  }

  function start(box) {
    if (box.dataset.frame !== undefined) return;
    box.style.backgroundImage = `url("${new URL(box.dataset.strip, root)}")`;
    box.style.backgroundSize = `${100 * Number(box.dataset.frames)}% 100%`;
    box.tabIndex = 0;
    box.setAttribute("role", "slider");
    box.setAttribute("aria-label", `${box.dataset.name}: drag, or use the arrow keys`);
    box.setAttribute("aria-valuemin", 1);
    box.setAttribute("aria-valuemax", box.dataset.frames);
    set(box, 0);
    let held = null;
    const stop = () => (box.dataset.still = "yes");
    box.addEventListener("pointerdown", (event) => {
      stop();
      held = { x: event.clientX, frame: Number(box.dataset.frame) };
      box.setPointerCapture(event.pointerId);
    });
    box.addEventListener("pointermove", (event) => {
      if (held) set(box, held.frame + Math.round((event.clientX - held.x) / STEP));
    });
    for (const end of ["pointerup", "pointercancel"]) box.addEventListener(end, () => (held = null));
    box.addEventListener("keydown", (event) => {
      const way = { ArrowRight: 1, ArrowUp: 1, ArrowLeft: -1, ArrowDown: -1 }[event.key];
      if (!way) return;
      stop();
      event.preventDefault();
      set(box, Number(box.dataset.frame) + way);
    });
    box.addEventListener("focus", stop);
  }

  const begin = () => document.querySelectorAll(".turn").forEach(start);
  if (document.readyState === "loading") document.addEventListener("DOMContentLoaded", begin);
  else begin();
  if (!calm) {
    setInterval(() => {
      for (const box of document.querySelectorAll(".turn")) {
        if (box.dataset.around !== "no" && box.dataset.still === undefined) set(box, Number(box.dataset.frame) + 1);
      }
    }, 160);
  }
})();
