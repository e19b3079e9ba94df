// Moving on the map: pointer, wheel, pinch, keys.

const CLOSE = { mouse: 14, pen: 18, touch: 26 };

function zoomAt(factor, x = points.clientWidth / 2, y = points.clientHeight / 2) {
  const before = scale(points.clientWidth, points.clientHeight);
  const [dx, dy] = [x - points.clientWidth / 2, y - points.clientHeight / 2];
  const place = [view.x + dx / before, view.y - dy / before];
  view.zoom = Math.min(LARGEST_ZOOM, Math.max(1, view.zoom * factor));
  const after = scale(points.clientWidth, points.clientHeight);
  moveTo(place[0] - dx / after, place[1] + dy / after);
}

/** Look at a place among the points; the whole map stays in the middle. */
function moveTo(x, y) {
  [view.x, view.y] = [x, y].map((value, axis) => {
    const slack = view.zoom > 1.01 ? extent[axis] / 2 : 0;
    return Math.min(Math.max(value, 0.5 - slack), 0.5 + slack);
  });
  points.style.touchAction = view.zoom > 1.01 ? "none" : "pan-y";
  redraw();
}

function wholeMap() {
  view.zoom = 1;
  moveTo(0.5, 0.5);
  pointAt(-1);
}

/** The point nearest to a pixel, -1 where none is close; scans count from -2 downwards. */
function nearestTo(x, y, close) {
  let [found, least] = [-1, close];
  state.scans.forEach((scan, k) => {
    const [u, v] = pixel(scan.place);
    if (Math.hypot(u - x, v - y) < 15) found = -2 - k;
  });
  if (found < -1) return found;
  for (let k = 0; k < COUNT; k++) {
    const [u, v] = pixel(atlas.places[k]);
    const apart = Math.hypot(u - x, v - y);
    if (apart < least && (state.only === null || state.only(k))) [found, least] = [k, apart];
  }
  return found;
}

function listen() {
  const held = new Map();
  let moved = 0;
  let apart = 0;
  const here = (event) => [event.offsetX, event.offsetY];

  points.addEventListener("pointerdown", (event) => {
    held.set(event.pointerId, here(event));
    [moved, apart] = [0, 0];
  });
  points.addEventListener("pointermove", (event) => {
    const before = held.get(event.pointerId);
    const now = here(event);
    if (!before) {
      if (event.pointerType !== "touch") pointAt(Math.max(-1, nearestTo(...now, CLOSE.mouse)));
      return;
    }
    held.set(event.pointerId, now);
    moved += Math.hypot(now[0] - before[0], now[1] - before[1]);
    if (held.size === 2) return pinch();
    if (moved < 5) return;
    points.setPointerCapture(event.pointerId);
    points.classList.add("moving");
    pointAt(-1);
    const s = scale(points.clientWidth, points.clientHeight);
    moveTo(view.x - (now[0] - before[0]) / s, view.y + (now[1] - before[1]) / s);
  });
  function pinch() {
    const [[ax, ay], [bx, by]] = [...held.values()];
    const now = Math.hypot(ax - bx, ay - by);
    if (apart) zoomAt(now / apart, (ax + bx) / 2, (ay + by) / 2);
    apart = now;
    moved = 99;
  }
  points.addEventListener("pointerup", (event) => {
    points.classList.remove("moving");
    if (!held.delete(event.pointerId) || moved >= 5) return;
    const found = nearestTo(...here(event), CLOSE[event.pointerType] ?? CLOSE.mouse);
    if (found < -1) showScan(-2 - found);
    else if (found >= 0) select(found);
  });
  points.addEventListener("pointercancel", (event) => held.delete(event.pointerId));
  points.addEventListener("pointerleave", (event) => { if (!held.has(event.pointerId)) pointAt(-1); });
  points.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoomAt(Math.exp(-0.0016 * event.deltaY), event.offsetX, event.offsetY);
  }, { passive: false });
  points.addEventListener("keydown", pressed);
  points.addEventListener("focus", () => { if (points.matches(":focus-visible")) pointAt(started(), true); });
  points.addEventListener("blur", () => pointAt(-1));
}

function pressed(event) {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const steps = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
  const zooms = { "+": 1.4, "=": 1.4, "-": 1 / 1.4, "−": 1 / 1.4 };
  if (steps[event.key]) walk(steps[event.key]);
  else if (zooms[event.key]) {
    if (state.at >= 0) moveTo(...atlas.places[state.at]);
    zoomAt(zooms[event.key]);
    pointAt(state.at);
  } else if (event.key === "0") wholeMap();
  else if (event.key === "Enter" || event.key === " ") open();
  else if (event.key === "Escape") pointAt(-1);
  else return;
  event.preventDefault();
}

function open() {
  if (state.at < 0) return;
  select(state.at);
  pointAt(-1);
}

/** Where the keyboard begins: the selected point, or the one nearest to the middle. */
function started() {
  if (state.selected >= 0) return state.selected;
  return nearestTo(points.clientWidth / 2, points.clientHeight / 2, Infinity);
}

/** The nearest point in a direction: one beside the way counts as farther. */
function walk([dx, dy]) {
  const from = state.at >= 0 ? state.at : started();
  if (state.at < 0) return pointAt(from, true);
  const [x, y] = pixel(atlas.places[from]);
  let [found, least] = [-1, Infinity];
  for (let k = 0; k < COUNT; k++) {
    const [u, v] = pixel(atlas.places[k]);
    const along = (u - x) * dx + (v - y) * dy;
    const beside = Math.abs((u - x) * dy) + Math.abs((v - y) * dx);
    const cost = along + 2.5 * beside;
    if (along > 0.5 && beside < 1.8 * along && cost < least && k !== from) [found, least] = [k, cost];
  }
  if (found < 0) return;
  const [u, v] = pixel(atlas.places[found]);
  if (u < 0 || v < 0 || u > points.clientWidth || v > points.clientHeight) moveTo(...atlas.places[found]);
  pointAt(found, true);
}
