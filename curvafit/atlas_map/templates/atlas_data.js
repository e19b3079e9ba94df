// What the page holds, and how numbers are said.

const $ = (id) => document.getElementById(id);
const atlas = JSON.parse($("data").textContent);
const COUNT = atlas.ids.length;
const texts = {};

/** The base64 of one piece of a text. */
function piece(name, k) {
  texts[name] ??= $(name).textContent;
  return texts[name].slice(atlas.offsets[name][k], atlas.offsets[name][k + 1]);
}

const thumbnail = (k) => `data:image/webp;base64,${piece("thumbnails", k)}`;

function bytes(name, k) {
  const text = atob(piece(name, k));
  const found = new Uint8Array(text.length);
  for (let i = 0; i < found.length; i++) found[i] = text.charCodeAt(i);
  return found;
}

/** The small volume of a shape, one byte a voxel. */
async function volume(k) {
  const stream = new Blob([bytes("volumes", k)]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** The diagram of a shape: κ1, κ2 and shares of area. */
function diagramOf(k) {
  const data = bytes("diagrams", k).buffer;
  const n = data.byteLength / 6;
  const step = atlas.diagram.scale;
  const [first, second] = [0, 2 * n].map((at) => Float64Array.from(new Int16Array(data, at, n), (value) => value * step));
  return { kappa1: first, kappa2: second, share: Float64Array.from(new Uint16Array(data, 4 * n, n)) };
}

const familyName = (k) => atlas.families[atlas.family[k]][0];
const clusterName = (k) => (atlas.cluster[k] === atlas.noise ? "no cluster" : `cluster ${atlas.clusters[atlas.cluster[k]][0]}`);

/** A number to so many significant digits, without an exponent where it reads well. */
function number(value, digits = 3) {
  if (!Number.isFinite(value)) return "–";
  if (value === 0) return "0";
  const rounded = Number(value.toPrecision(digits));
  const power = Math.floor(Math.log10(Math.abs(rounded)));
  const text = power < -4 || power > 6 ? rounded.toExponential(digits - 1) : rounded.toFixed(Math.max(0, digits - 1 - power));
  return text.replace(/-/g, "−");
}

/** An element with attributes and children. */
function element(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name in made && name !== "style") made[name] = value;
    else made.setAttribute(name, value);
  }
  made.append(...children);
  return made;
}

const said = (text) => { $("said").textContent = text; };
const themed = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
const dark = matchMedia("(prefers-color-scheme: dark)");

/** The canvas's pixels made to fit its box; its context's unit is then a CSS pixel. */
function fitted(canvas) {
  const { width, height } = canvas.getBoundingClientRect();
  const ratio = Math.min(window.devicePixelRatio || 1, 2);
  const size = [Math.max(1, Math.round(width * ratio)), Math.max(1, Math.round(height * ratio))];
  if (canvas.width !== size[0] || canvas.height !== size[1]) [canvas.width, canvas.height] = size;
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  return { context, width, height };
}
