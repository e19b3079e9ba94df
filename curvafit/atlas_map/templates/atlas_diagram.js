// A curvature diagram, as the pictures of the package draw it: area over (κ1, κ2), colours by the logarithm.

const BINS = 72;
const DECADES = 3;

/** Draw a diagram (none: nothing) on a canvas that is shown. */
function drawDiagram(canvas, found) {
  if (!found || !canvas.clientWidth) return;
  const { context, width } = fitted(canvas);
  const [low, high] = atlas.diagram.limits;
  const [left, bottom, top] = [30, width - 26, 4];
  const side = Math.min(width - left - 4, bottom - top);
  const x = (kappa) => left + ((kappa - low) / (high - low)) * side;
  const y = (kappa) => bottom - ((kappa - low) / (high - low)) * side;
  context.font = "11px system-ui, sans-serif";
  backdrop(context, x, y, low, high);
  context.drawImage(density(found, low, high), left, bottom - side, side, side);
  line(context, [[x(low), y(low)], [x(high), y(high)]], "#C8372D", 1.4);
  axes(context, x, y, low, high);
}

function backdrop(context, x, y, low, high) {
  context.fillStyle = themed("soft");
  context.beginPath();
  for (const [a, b] of [[low, low], [low, high], [high, high]]) context.lineTo(x(a), y(b));
  context.fill();
  line(context, [[x(low), y(0)], [x(high), y(0)]], themed("quiet"), 0.7);
  line(context, [[x(0), y(low)], [x(0), y(high)]], themed("quiet"), 0.7);
}

function axes(context, x, y, low, high) {
  line(context, [[x(low), y(high)], [x(high), y(high)], [x(high), y(low)], [x(low), y(low)], [x(low), y(high)]], themed("line"), 1);
  const step = roundStep((high - low) / 4);
  context.fillStyle = themed("quiet");
  for (let tick = Math.ceil(low / step) * step; tick <= high; tick += step) {
    const text = String(Math.round(tick)).replace("-", "−");
    context.textAlign = "center";
    if (x(tick) > x(low) + 12) context.fillText(text, x(tick), y(low) + 13);
    context.textAlign = "right";
    context.fillText(text, x(low) - 4, y(tick) + 4);
  }
  context.fillStyle = themed("ink");
  context.textAlign = "right";
  context.fillText("κ₁", x(high), y(low) + 25);
  context.textAlign = "left";
  context.fillText("κ₂", x(low) + 5, y(high) + 13);
}

/** The least of 1, 2, 5 x 10^n that is not under a length. */
function roundStep(length) {
  const power = 10 ** Math.floor(Math.log10(length));
  return [1, 2, 5, 10].map((step) => step * power).find((step) => step >= length);
}

function line(context, places, colour, width) {
  context.strokeStyle = colour;
  context.lineWidth = width;
  context.beginPath();
  for (const place of places) context.lineTo(...place);
  context.stroke();
}

/** A picture of BINS x BINS: shares of area, a little smoothed, three decades of colour. */
function density(found, low, high) {
  const cells = smoothed(binned(found, low, high));
  const highest = Math.max(...cells, 1e-12);
  const stops = dark.matches ? [...atlas.ramps.density].reverse() : atlas.ramps.density;
  const picture = element("canvas", { width: BINS, height: BINS });
  const context = picture.getContext("2d");
  for (let row = 0; row < BINS; row++) {
    for (let column = 0; column < BINS; column++) {
      const share = 1 + Math.log10(cells[row * BINS + column] / highest) / DECADES;
      if (!(share > 0)) continue;
      context.fillStyle = ramp(stops, share);
      context.fillRect(column, BINS - 1 - row, 1, 1);
    }
  }
  return picture;
}

function binned({ kappa1, kappa2, share }, low, high) {
  const cells = new Float64Array(BINS * BINS);
  for (let k = 0; k < share.length; k++) {
    const [column, row] = [kappa1[k], kappa2[k]].map((kappa) => Math.floor(((kappa - low) / (high - low)) * BINS));
    if (column >= 0 && row >= 0 && column < BINS && row < BINS) cells[row * BINS + column] += share[k];
  }
  return cells;
}

/** A Gaussian of 0.8 cells, along rows and columns. */
function smoothed(cells) {
  const weights = [-3, -2, -1, 0, 1, 2, 3].map((step) => Math.exp((-step * step) / (2 * 0.64)));
  const total = weights.reduce((sum, weight) => sum + weight);
  let now = cells;
  for (const stride of [1, BINS]) {
    const next = new Float64Array(now.length);
    for (let k = 0; k < now.length; k++) {
      const place = stride === 1 ? k % BINS : Math.floor(k / BINS);
      weights.forEach((weight, at) => {
        const to = Math.min(Math.max(place + at - 3, 0), BINS - 1);
        next[k] += (weight / total) * now[k + (to - place) * stride];
      });
    }
    now = next;
  }
  return now;
}
