// The map: points on a canvas, moved and zoomed, hovered and walked from point to point.

const points = $("points");
const LARGEST_ZOOM = 60;
const EDGE = 26;
const view = { zoom: 1, x: 0.5, y: 0.5 };
const state = { at: -1, selected: -1, colour: "family", only: null, pictures: false, scans: [], scan: -1 };
const columns = Object.fromEntries(atlas.columns.map((column) => [column.key, column]));
const extent = [0, 1].map((axis) => {
  const along = atlas.places.map((place) => place[axis]);
  return Math.max(...along) - Math.min(...along);
});
const images = new Map();
let wanted = 0;

/** Draw with the next frame, once however often it is asked for. */
function redraw() {
  wanted ||= requestAnimationFrame(() => { wanted = 0; draw(); });
}

function scale(width, height) {
  const room = Math.min((width - 2 * EDGE) / Math.max(extent[0], 0.05), (height - 2 * EDGE) / Math.max(extent[1], 0.05));
  return Math.max(room, 10) * view.zoom;
}

/** Where a place of the map is in the canvas. */
function pixel([x, y], width = points.clientWidth, height = points.clientHeight) {
  const s = scale(width, height);
  return [width / 2 + (x - view.x) * s, height / 2 - (y - view.y) * s];
}

function draw() {
  const { context, width, height } = fitted(points);
  const colours = colouring();
  const radius = Math.min(9, 3.6 * Math.sqrt(Math.sqrt(view.zoom)) * (COUNT > 400 ? 1 : 1.35) * (width < 500 ? 0.75 : 1));
  context.lineWidth = 1;
  context.strokeStyle = themed("rim");
  const dots = atlas.places.map((place) => pixel(place, width, height));
  for (let k = 0; k < COUNT; k++) {
    context.globalAlpha = state.only === null || state.only(k) ? 0.95 : 0.1;
    context.fillStyle = colours[k];
    dot(context, dots[k], radius);
    context.stroke();
  }
  context.globalAlpha = 1;
  if (state.pictures) drawPictures(context, dots, width, height);
  if (state.selected >= 0) links(context, dots[state.selected], atlas.neighbours[state.selected].map((k) => dots[k]));
  state.scans.forEach((scan, k) => star(context, pixel(scan.place, width, height), scan.near.map(([n]) => dots[n]), k === state.scan));
  for (const [k, wide] of [[state.at, 2], [state.selected, 3]]) {
    if (k >= 0) ring(context, dots[k], radius + wide + 1, wide, k === state.selected ? themed("accent") : themed("ink"));
  }
}

function dot(context, [x, y], radius) {
  context.beginPath();
  context.arc(x, y, radius, 0, 2 * Math.PI);
  context.fill();
}

function ring(context, [x, y], radius, width, colour) {
  context.beginPath();
  context.arc(x, y, radius, 0, 2 * Math.PI);
  context.lineWidth = width;
  context.strokeStyle = colour;
  context.stroke();
}

function links(context, from, ends) {
  context.lineWidth = 1.2;
  context.strokeStyle = themed("accent");
  context.globalAlpha = 0.75;
  context.beginPath();
  for (const end of ends) {
    context.moveTo(...from);
    context.lineTo(...end);
  }
  context.stroke();
  context.globalAlpha = 1;
}

function star(context, [x, y], ends, chosen) {
  links(context, [x, y], ends);
  context.beginPath();
  for (let k = 0; k < 10; k++) {
    const [radius, angle] = [k % 2 ? 5 : chosen ? 13 : 11, (Math.PI * k) / 5];
    context.lineTo(x + radius * Math.sin(angle), y - radius * Math.cos(angle));
  }
  context.closePath();
  context.lineWidth = 4;
  context.lineJoin = "round";
  context.strokeStyle = themed("halo");
  context.stroke();
  context.fillStyle = themed("accent");
  context.fill();
}

/** Thumbnails at as many points as there is room for. */
function drawPictures(context, dots, width, height) {
  const [side, taken] = [width < 500 ? 44 : 60, []];
  const order = [...dots.keys()].sort((a, b) => (b === state.selected) - (a === state.selected) || a - b);
  for (const k of order) {
    const [x, y] = dots[k];
    if (x < 0 || y < 0 || x > width || y > height || (state.only !== null && !state.only(k))) continue;
    if (taken.some(([u, v]) => Math.abs(u - x) < side && Math.abs(v - y) < side)) continue;
    taken.push([x, y]);
    if (!images.has(k)) {
      const image = element("img", { src: thumbnail(k) });
      image.decode().then(redraw, () => {});
      images.set(k, image);
    }
    if (images.get(k).complete) context.drawImage(images.get(k), x - side / 2, y - side / 2, side, side);
  }
}

// ---- colours --------------------------------------------------------------------------------------------------------

/** A colour for every point. */
function colouring() {
  const column = columns[state.colour];
  if (column) {
    const [low, high] = range(column.values);
    return column.values.map((value) => ramp(atlas.ramps.values, (value - low) / (high - low || 1)));
  }
  if (state.colour === "family") return atlas.family.map((kind) => atlas.families[kind][1]);
  return atlas.cluster.map((kind) => (kind === atlas.noise ? themed("noise") : atlas.clusters[kind][1]));
}

const range = (values) => [Math.min(...values), Math.max(...values)];

function ramp(stops, share) {
  const place = Math.min(Math.max(share, 0), 1) * (stops.length - 1);
  const low = Math.min(Math.floor(place), stops.length - 2);
  return mix(stops[low], stops[low + 1], place - low);
}

function mix(one, other, share) {
  const parts = [1, 3, 5].map((at) => {
    const [a, b] = [one, other].map((colour) => parseInt(colour.slice(at, at + 2), 16));
    return Math.round(a + (b - a) * share);
  });
  return `rgb(${parts.join(" ")})`;
}

/** The legend: a colour bar, or the groups as buttons that single one out. */
function drawLegend() {
  const legend = $("legend");
  legend.replaceChildren();
  state.only = null;
  const column = columns[state.colour];
  if (column) {
    const [low, high] = range(column.values);
    const bar = element("span", { className: "ramp", style: `background: linear-gradient(90deg, ${atlas.ramps.values.join(",")})` });
    legend.append(element("span", {}, `${column.symbol}, ${column.says}:`), number(low), bar, number(high));
    return;
  }
  const own = state.colour === "family";
  const kinds = own ? atlas.family : atlas.cluster;
  (own ? atlas.families : atlas.clusters).forEach(([name, colour], kind) => {
    group(legend, name, colour, (k) => kinds[k] === kind);
  });
  if (!own) group(legend, "no cluster", themed("noise"), (k) => atlas.cluster[k] === atlas.noise);
}

function group(legend, name, colour, holds) {
  const count = atlas.ids.filter((_, k) => holds(k)).length;
  if (!count) return;
  const swatch = element("span", { className: "swatch", style: `background:${colour}` });
  const button = element("button", { type: "button", "aria-pressed": "false" }, swatch, name, element("span", { className: "count" }, String(count)));
  button.addEventListener("click", () => {
    const on = button.getAttribute("aria-pressed") !== "true";
    for (const other of legend.querySelectorAll("button")) other.setAttribute("aria-pressed", "false");
    button.setAttribute("aria-pressed", String(on));
    state.only = on ? holds : null;
    redraw();
  });
  legend.append(button);
}

// ---- the tip --------------------------------------------------------------------------------------------------------

/** Say what point is under the pointer or the keyboard, with its picture; -1 for none. */
function pointAt(k, aloud = false) {
  if (k !== state.at) {
    state.at = k;
    points.classList.toggle("point", k >= 0);
    redraw();
  }
  const tip = $("tip");
  tip.hidden = k < 0;
  if (k < 0) return;
  const column = columns[state.colour];
  const value = column ? `, ${column.symbol} ${number(column.values[k])}` : "";
  tip.querySelector("img").src = thumbnail(k);
  tip.querySelector("p").replaceChildren(element("b", {}, atlas.ids[k]), element("br"), familyName(k) + value);
  const [x, y] = pixel(atlas.places[k]);
  const [w, h] = [tip.offsetWidth, tip.offsetHeight];
  const left = x + w + 18 < points.clientWidth ? x + 16 : Math.max(0, x - w - 16);
  tip.style.transform = `translate(${left}px, ${Math.min(Math.max(y - h / 2, 0), Math.max(0, points.clientHeight - h))}px)`;
  if (aloud) said(`${atlas.ids[k]}, ${familyName(k)}${value}`);
}
