// A scan's fit.json on the map. Nothing is sent anywhere: the page measures it against what it holds.

const [DIRECTIONS, QUANTILES] = [12, 24];
let embeddings;

/** Sliced-quantile embedding of a diagram, as `curvafit.geometry.transport.sliced_embedding` has it. */
function embedded({ kappa1, kappa2, share }) {
  const total = share.reduce((sum, part) => sum + part, 0);
  const found = [];
  for (let d = 0; d < DIRECTIONS; d++) {
    const angle = (Math.PI * d) / DIRECTIONS;
    const along = kappa1.map((kappa, k) => kappa * Math.cos(angle) + kappa2[k] * Math.sin(angle));
    const order = [...along.keys()].sort((a, b) => along[a] - along[b]);
    const reached = [];
    let sum = 0;
    for (const k of order) {
      reached.push((sum + share[k] / 2) / total);
      sum += share[k];
    }
    for (let q = 0, k = 0; q < QUANTILES; q++) {
      const level = (q + 0.5) / QUANTILES;
      while (k < order.length && reached[k] < level) k++;
      const [a, b] = [along[order[Math.max(k - 1, 0)]], along[order[Math.min(k, order.length - 1)]]];
      const part = k === 0 || k === order.length ? 0 : (level - reached[k - 1]) / (reached[k] - reached[k - 1]);
      found.push((a + (b - a) * part) / Math.sqrt(DIRECTIONS * QUANTILES));
    }
  }
  return found;
}

/** The shapes nearest to a diagram, [shape, sliced distance], nearest first. */
function nearestShapes(diagram, seenAs) {
  embeddings ??= [0, 1].map((k) => new Int16Array(bytes("embeddings", k).buffer));
  const rows = embeddings[seenAs === "field" ? 0 : 1];
  const query = embedded(diagram);
  const found = atlas.ids.map((_, k) => {
    let sum = 0;
    for (let j = 0; j < query.length; j++) sum += (rows[k * query.length + j] * atlas.embedding.scale - query[j]) ** 2;
    return [k, Math.sqrt(sum)];
  });
  return found.sort((a, b) => a[1] - b[1]).slice(0, atlas.embedding.nearest);
}

/** What a fit.json says of its place; raises a sentence where it says nothing. */
function placed(fit, file) {
  const wrong = violation(fit, atlas.fit);
  if (wrong) throw new Error(`expected a fit.json with ${wrong} in ${file}`);
  if (fit.diagram && !whole(fit.diagram)) throw new Error(`expected a fit.json with a whole diagram, got ${file}`);
  const diagram = fit.diagram && {
    kappa1: fit.diagram.kappa1, kappa2: fit.diagram.kappa2, share: fit.diagram.share,
  };
  const seenAs = (fit.diagram?.seen_as ?? fit.kind) === "field" ? "field" : "mask";
  const near = diagram ? nearestShapes(diagram, seenAs) : ownMatches(fit);
  if (!near.length) {
    const mend = lawful(fit) ? "run curvafit infer again" : fit.status ?? "it has no law";
    throw new Error(`expected the scan's diagram or matches in this atlas, got neither in ${file}: ${mend}`);
  }
  const weights = near.map(([, apart]) => 1 / (apart * apart + 1e-6));
  const total = weights.reduce((sum, weight) => sum + weight);
  const place = [0, 1].map((axis) => near.reduce((sum, [k], at) => sum + (weights[at] / total) * atlas.places[k][axis], 0));
  const spread = Math.max(...near.map(([k]) => Math.hypot(atlas.places[k][0] - place[0], atlas.places[k][1] - place[1])));
  return { fit, file, diagram, seenAs, near, place, spread };
}

/** Whether a fit has a law, as `Law.load` asks. */
const lawful = (fit) => [fit.coefficients, fit.mass, fit.coefficients_physical].every((part) => part !== null);

/** Whether a diagram's three columns are of one length, with some area. */
function whole({ kappa1, kappa2, share }) {
  return kappa1.length === share.length && kappa2.length === share.length && share.some((part) => part > 0);
}

/** Matches that `infer` found, where they are shapes of this very atlas: same name, same parameters. */
function ownMatches(fit) {
  const same = (match, k) => k >= 0 && ["a11", "a02", "a10", "a01", "a00"].every((name) => {
    const [mine, other] = [columns[name].values[k], match.coefficients[name]];
    return Math.abs(mine - other) <= 1e-9 * Math.max(1, Math.abs(mine));
  });
  return (fit.matches ?? []).map((match) => [match, atlas.ids.indexOf(match.id)]).filter(([match, k]) => same(match, k))
    .map(([match, k]) => [k, match.distance]);
}

/** How it was placed, and how far to trust that. */
function account({ fit, diagram, seenAs, near, spread }) {
  const say = [`The scan lies at the barycentre of its ${near.length} nearest shapes, each weighted by 1/distance².`];
  if (!diagram) {
    say.push("This fit.json holds no diagram: the nearest shapes are the matches of curvafit infer, with its distances.");
  } else {
    const [half, most] = atlas.embedding.usual[seenAs];
    const least = near[0][1];
    say.push(`The page compared its diagram with those of the atlas’s ${seenAs}s, by sliced Wasserstein distance.`);
    say.push(least <= most
      ? `The nearest shape is ${number(least)} away; half of the atlas’s shapes have a neighbour within ${number(half)}.`
      : `The nearest shape is ${number(least)} away, farther than 95 % of the atlas’s shapes are from their neighbours: the scan may lie off the map.`);
  }
  if (spread > 0.15) say.push("The nearest shapes lie far apart on the map, so the scan’s place is uncertain.");
  if (!lawful(fit) && fit.status) say.push(fit.status);
  return say.join(" ");
}

async function read(file) {
  try {
    const text = await file.text();
    let fit;
    try {
      fit = JSON.parse(text);
    } catch {
      throw new Error(`expected a fit.json, got ${file.name}, which is not JSON`);
    }
    state.scans.push(placed(fit, file.name));
    $("message").hidden = true;
    showScan(state.scans.length - 1);
  } catch (error) {
    $("message").textContent = error.message;
    $("message").hidden = false;
  }
}

function showScan(at) {
  const scan = state.scans[at];
  const { fit } = scan;
  [state.scan, state.selected] = [at, -1];
  reveal("scan", true);
  $("scan-name").textContent = String(fit.provenance?.scan ?? scan.file).split(/[\\/]/).pop() || scan.file;
  $("scan-kind").replaceChildren(element("span", { className: "star" }, "★ "), `scan, seen as ${scan.seenAs}; ${fit.family ?? "family not known"}`);
  $("scan-says").textContent = account(scan);
  strip("scan-near", scan.near.map(([k]) => k), scan.near.map(([, apart]) => apart));
  $("scan-unit").textContent = scan.diagram ? "Sliced Wasserstein distances between curvature diagrams, in 1/working unit."
    : "Wasserstein distances of curvafit infer, in 1/working unit.";
  const known = { ...fit.coefficients, m0: fit.mass, volume: fit.morphometry?.volume_fraction };
  table("scan-parameters", atlas.columns.map(({ key, symbol, says }) => [symbol, says, known[key] ?? NaN]));
  $("scan-law").hidden = !lawful(fit);
  command("scan-command", `curvafit generate --prior ${quoted(scan.file)} --seed 1 -o more.nii.gz`);
  $("scan-figure").hidden = !scan.diagram;
  drawDiagram($("scan-diagram"), scan.diagram);
  said(`${$("scan-name").textContent} is on the map. ${$("scan-says").textContent}`);
  moveTo(...scan.place);
}

/** A name as a shell takes it. */
const quoted = (name) => (/^[\w./-]+$/.test(name) ? name : `'${name.replace(/'/g, "'\\''")}'`);

function removeScan() {
  state.scans.splice(state.scan, 1);
  state.scan = -1;
  reveal("welcome", false);
  redraw();
}
