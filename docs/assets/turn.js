// Strips of pictures (examples/turning.py) that turn by dragging, by the arrow keys, and slowly by themselves.
// Markup: <div class="turn" data-strip="gallery/tubes.webp" data-frames="24" data-name="tubes"></div>, the strip named
// from the site's root. A strip of laws between two has two ends, a range to choose one by, and its numbers:
// <figure class="between" data-first="2 2 …" data-last="2 2 …">, with a .turn, an <input type="range"> and an <output>.
(() => {
  const root = new URL("..", document.currentScript.src);
  const STEP = 8; // pixels of a drag for the next picture
  const NUMBERS = ["a₂₀", "a₁₁", "a₀₂", "a₁₀", "a₀₁", "a₀₀", "m₀"];
  const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
  const between = (box) => box.closest(".between");

  function set(box, index) {
    const count = Number(box.dataset.frames);
    const pair = between(box);
    const frame = pair ? Math.min(Math.max(index, 0), count - 1) : ((index % count) + count) % count;
    box.dataset.frame = frame;
    box.style.backgroundPosition = `${(100 * frame) / (count - 1)}% 0`;
    if (pair) return write(pair, frame, count);
    box.setAttribute("aria-valuenow", frame + 1);
    box.setAttribute("aria-valuetext", `${Math.round((360 * frame) / count)} degrees`);
  }

  function write(pair, frame, count) {
    const [first, last] = [pair.dataset.first, pair.dataset.last].map((numbers) => numbers.split(" ").map(Number));
    const share = frame / (count - 1);
    const range = pair.querySelector("input");
    range.value = frame;
    range.setAttribute("aria-valuetext", `${Math.round(100 * share)} percent of the way`);
    pair.querySelector("output").replaceChildren(
      ...NUMBERS.map((name, k) => {
        const value = Number(((1 - share) * first[k] + share * last[k]).toFixed(3));
        return Object.assign(document.createElement("span"), { textContent: `${name} = ${value}` });
      }),
    );
  }

  function start(box) {
    if (box.dataset.frame !== undefined) return;
    box.style.backgroundImage = `url("${new URL(box.dataset.strip, root)}")`;
    box.style.backgroundSize = `${100 * Number(box.dataset.frames)}% 100%`;
    const stop = () => (box.dataset.still = "yes");
    let held = null;
    box.addEventListener("pointerdown", (event) => {
      stop();
      held = { x: event.clientX, frame: Number(box.dataset.frame) };
      box.setPointerCapture(event.pointerId);
    });
    box.addEventListener("pointermove", (event) => {
      if (held) set(box, held.frame + Math.round((event.clientX - held.x) / STEP));
    });
    for (const end of ["pointerup", "pointercancel"]) box.addEventListener(end, () => (held = null));
    if (between(box)) startRange(box, between(box).querySelector("input"));
    else startKeys(box, stop);
    set(box, 0);
  }

  function startRange(box, range) {
    box.setAttribute("role", "img");
    box.setAttribute("aria-label", box.dataset.name);
    range.max = Number(box.dataset.frames) - 1;
    range.addEventListener("input", () => set(box, Number(range.value)));
  }

  function startKeys(box, stop) {
    box.tabIndex = 0;
    box.setAttribute("role", "slider");
    box.setAttribute("aria-label", `${box.dataset.name}: drag, or use the arrow keys`);
    box.setAttribute("aria-valuemin", 1);
    box.setAttribute("aria-valuemax", box.dataset.frames);
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
        if (!between(box) && box.dataset.still === undefined) set(box, Number(box.dataset.frame) + 1);
      }
    }, 160);
  }
})();
