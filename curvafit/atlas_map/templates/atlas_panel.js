// What is known of the selected shape.

let showSolid;

/** Show a shape: its volume, diagram, parameters, command and neighbours. */
function select(k, follow = true) {
  state.selected = k;
  state.scan = -1;
  reveal("shape", follow);
  $("shape-name").textContent = atlas.ids[k];
  const group = atlas.families[atlas.family[k]][1];
  $("shape-kind").replaceChildren(element("span", { className: "swatch", style: `background:${group}` }), `${familyName(k)}, ${clusterName(k)}`);
  table("parameters", atlas.columns.map((column) => [column.symbol, column.says, column.values[k]]));
  command("command", atlas.commands[k]);
  strip("near", atlas.neighbours[k], atlas.distances[k]);
  solid(k);
  drawDiagram($("diagram"), diagramOf(k));
  $("diagram").setAttribute("aria-label", `Curvature diagram of shape ${atlas.ids[k]}`);
  history.replaceState(null, "", `#${atlas.ids[k]}`);
  said(`Shape ${atlas.ids[k]}, ${familyName(k)}, is shown`);
  redraw();
}

/** Put one section into the panel; on a narrow page, go there. */
function reveal(name, follow) {
  for (const each of ["welcome", "shape", "scan"]) $(each).hidden = each !== name;
  const panel = $("panel");
  panel.scrollTop = 0;
  if (follow && getComputedStyle(panel.parentElement).display === "block") {
    panel.scrollIntoView({ behavior: matchMedia("(prefers-reduced-motion: reduce)").matches ? "auto" : "smooth" });
  }
}

function solid(k) {
  const canvas = $("solid");
  showSolid ??= viewer(canvas) ?? "none";
  const able = showSolid !== "none";
  canvas.hidden = !able;
  $("flat").hidden = able;
  $("solid-help").textContent = able ? $("solid-help").textContent : "This browser has no WebGL 2, so the shape cannot be turned; this is its picture.";
  canvas.setAttribute("aria-label", `Shape ${atlas.ids[k]} in 3D, ${familyName(k)}`);
  Object.assign($("flat"), { src: thumbnail(k), alt: `Shape ${atlas.ids[k]}, ${familyName(k)}` });
  if (able) showSolid(k).catch((error) => said(`The shape cannot be drawn: ${error.message}`));
}

function table(id, rows) {
  $(id).tBodies[0].replaceChildren(...rows.map(([symbol, says, value]) => element(
    "tr", {}, element("th", { scope: "row", title: says }, symbol), element("td", {}, typeof value === "string" ? value : number(value)),
  )));
}

/** A command that breaks between its words, and within the long ones only. */
function command(id, text) {
  const words = text.split(" ").map((word) => element("span", { className: word.length < 40 ? "word" : "" }, word));
  $(id).replaceChildren(...words.flatMap((word) => [word, " "]).slice(0, -1));
}

/** Buttons with pictures and distances. */
function strip(id, shapes, distances) {
  $(id).replaceChildren(...shapes.map((k, at) => {
    const image = element("img", { src: thumbnail(k), alt: "" });
    const label = `Shape ${atlas.ids[k]}, ${familyName(k)}, distance ${number(distances[at])}`;
    const button = element("button", { type: "button", title: atlas.ids[k], "aria-label": label }, image, number(distances[at]));
    button.addEventListener("click", () => {
      select(k, false);
      $("near").querySelector("button")?.focus({ preventScroll: true });
    });
    for (const name of ["pointerenter", "focus"]) button.addEventListener(name, () => { state.at = k; redraw(); });
    for (const name of ["pointerleave", "blur"]) button.addEventListener(name, () => { state.at = -1; redraw(); });
    return button;
  }));
}

/** Copy what a block holds, and say so on its button. */
async function copy(block, button) {
  const text = block.textContent;
  try {
    await navigator.clipboard.writeText(text);
  } catch {
    getSelection().selectAllChildren(block);
    document.execCommand("copy");
  }
  button.textContent = "Copied";
  said("The command is copied");
  setTimeout(() => { button.textContent = "Copy"; }, 1600);
}
