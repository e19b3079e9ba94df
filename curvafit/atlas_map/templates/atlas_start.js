// Everything wired up.

const choices = [["family", "family"], ["cluster", "cluster"], ...atlas.columns.map(({ key, symbol, says }) => [key, `${symbol}, ${says}`])];
$("colour").append(...choices.map(([value, says]) => element("option", { value }, says)));
$("ids").append(...atlas.ids.map((value) => element("option", { value })));
points.setAttribute("aria-label", `Map of ${COUNT} shapes`);

$("colour").addEventListener("change", () => {
  state.colour = $("colour").value;
  drawLegend();
  redraw();
});
$("find").addEventListener("change", () => {
  const k = atlas.ids.indexOf($("find").value.trim());
  $("message").hidden = k >= 0 || !$("find").value;
  $("message").textContent = `expected the name of a shape of this atlas, such as ${atlas.ids[0]}, got ${$("find").value}`;
  if (k >= 0) {
    select(k);
    view.zoom = Math.max(view.zoom, 4);
    moveTo(...atlas.places[k]);
  }
});
$("pictures").addEventListener("click", () => {
  state.pictures = !state.pictures;
  $("pictures").setAttribute("aria-pressed", String(state.pictures));
  redraw();
});
$("whole").addEventListener("click", wholeMap);
$("open").addEventListener("click", () => $("file").click());
$("file").addEventListener("change", async () => {
  for (const file of $("file").files) await read(file);
  $("file").value = "";
});
for (const [button, block] of [["copy", "command"], ["scan-copy", "scan-command"]]) {
  $(button).addEventListener("click", () => copy($(block), $(button)));
}
$("scan-remove").addEventListener("click", removeScan);

let over = 0;
addEventListener("dragenter", (event) => { event.preventDefault(); over += 1; $("drop").hidden = false; });
addEventListener("dragleave", () => { over -= 1; $("drop").hidden = over > 0; });
addEventListener("dragover", (event) => event.preventDefault());
addEventListener("drop", async (event) => {
  event.preventDefault();
  over = 0;
  $("drop").hidden = true;
  for (const file of event.dataTransfer.files) await read(file);
});

function diagrams() {
  if (state.selected >= 0) drawDiagram($("diagram"), diagramOf(state.selected));
  if (state.scan >= 0) drawDiagram($("scan-diagram"), state.scans[state.scan].diagram);
}
dark.addEventListener("change", () => {
  drawLegend();
  redraw();
  diagrams();
});
new ResizeObserver(redraw).observe(points);
for (const id of ["diagram", "scan-diagram"]) new ResizeObserver(diagrams).observe($(id));
addEventListener("hashchange", opened);

function opened() {
  const k = atlas.ids.indexOf(location.hash.slice(1));
  if (k >= 0 && k !== state.selected) select(k, false);
}

listen();
drawLegend();
draw();
opened();
document.documentElement.dataset.ready = String(Math.round(performance.now()));
