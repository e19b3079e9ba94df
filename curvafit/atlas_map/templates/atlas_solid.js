// A shape in 3D: rays marched through its small volume in WebGL 2, lit as the package's own pictures are.

const START = { azimuth: 32, elevation: 24, zoom: 1 };
const REST_MS = 140;

const VERTEX = `#version 300 es
in vec2 corner;
void main() { gl_Position = vec4(corner, 0.0, 1.0); }`;

const FRAGMENT = `#version 300 es
precision highp float;
precision highp sampler3D;
uniform sampler3D field;
uniform vec3 box, right, up, towards, light, voxel;
uniform vec2 size;
uniform float half_, level, fog, slope, cut;
uniform int samples;
out vec4 colour;
const vec3 SURFACE = vec3(0.945, 0.865, 0.715);
const float MISS = -99.0;
const vec3 CAP = vec3(0.86, 0.64, 0.47);

float at(vec3 p) { return textureLod(field, p / box + 0.5, 0.0).r - level; }
float blurred(vec3 p, float detail) { return smoothstep(-0.24, 0.24, textureLod(field, p / box + 0.5, detail).r - level); }

vec2 span(vec3 o, vec3 d, out vec3 normal) {
  vec3 safe = mix(d, vec3(1e-7), lessThan(abs(d), vec3(1e-7)));
  vec3 a = (-0.5 * box - o) / safe, b = (0.5 * box - o) / safe;
  vec3 near = min(a, b), far = max(a, b);
  float start = max(near.x, max(near.y, near.z));
  normal = -sign(safe) * vec3(equal(near, vec3(start)));
  return vec2(start, min(far.x, min(far.y, far.z)));
}

/* How far the surface is at least, judged by the profile: u is tanh(d / slope) near it. */
float stride(float value, float least, float unit) {
  return max(least * unit, 0.6 * slope * atanh(min(-value / level, 0.98) * cut));
}

float march(vec3 o, vec3 d, float start, float stop, float unit) {
  float t = start, last = start;
  for (int k = 0; k < 400; k++) {
    if (t > stop) return MISS;
    float value = at(o + t * d);
    if (value > 0.0) {
      for (int n = 0; n < 7; n++) {
        float middle = 0.5 * (last + t);
        if (at(o + middle * d) > 0.0) t = middle; else last = middle;
      }
      return t;
    }
    last = t;
    t += stride(value, 0.12, unit);
  }
  return MISS;
}

vec3 outward(vec3 p) {
  vec3 e = 2.0 * voxel;
  return -normalize(vec3(
    at(p + vec3(e.x, 0, 0)) - at(p - vec3(e.x, 0, 0)),
    at(p + vec3(0, e.y, 0)) - at(p - vec3(0, e.y, 0)),
    at(p + vec3(0, 0, e.z)) - at(p - vec3(0, 0, e.z))) / e + 1e-9);
}

float lit(vec3 p, vec3 n, float unit) {
  float facing = dot(n, light), highest = -1.0;
  if (facing <= 0.0) return 0.0;
  vec3 ignored, q = p + 1.5 * unit * n;
  float stop = span(q, light, ignored).y;
  float noise = fract(52.98 * fract(dot(gl_FragCoord.xy, vec2(0.0671, 0.00584))));
  for (float t = (0.5 + 0.5 * noise) * unit; t < stop && highest < 0.0;) {
    float value = at(q + t * light);
    highest = max(highest, value);
    t += stride(value, 0.4, unit);
  }
  return facing * (1.0 - 0.6 * smoothstep(-0.3, 0.0, highest));
}

vec4 ray(vec2 place) {
  float unit = min(voxel.x, min(voxel.y, voxel.z));
  vec3 o = half_ * (place.x * right + place.y * up), d = -towards, n;
  vec2 t = span(o, d, n);
  if (t.x >= t.y) return vec4(0.0);
  bool capped = at(o + (t.x + 1e-4) * d) > 0.0;
  float hit = capped ? t.x : march(o, d, t.x, t.y, unit);
  if (hit == MISS) return vec4(0.0);
  vec3 p = o + hit * d;
  if (!capped) n = outward(p);
  float sky = 1.0;
  if (!capped) {
    float close = blurred(p + 2.5 * unit * n, 1.3), wide = blurred(p + 7.0 * unit * n, 2.6);
    sky = (1.0 - clamp((close - 0.12) * 1.5, 0.0, 0.7)) * (1.0 - clamp((wide - 0.05) * 1.3, 0.0, 0.6));
  }
  float glow = 1.05 * ((0.50 + 0.14 * dot(n, towards)) * sky + 0.52 * lit(p, n, unit) * (0.55 + 0.45 * sky));
  float haze = 0.30 * pow(clamp(0.5 + hit / (2.0 * length(box)), 0.0, 1.0), 1.5);
  vec3 found = pow(min((capped ? CAP : SURFACE) * clamp(glow, 0.0, 1.1), 1.0), vec3(0.9));
  return vec4(mix(found, vec3(fog), haze), 1.0);
}

void main() {
  vec4 sum = vec4(0.0);
  for (int k = 0; k < 4; k++) {
    if (k >= samples) break;
    vec2 shift = samples == 1 ? vec2(0.0) : vec2(k & 1, k >> 1) * 0.5 - 0.25;
    sum += ray(2.0 * (gl_FragCoord.xy + shift) / size - 1.0);
  }
  colour = sum / float(samples);
}`;

/** The viewer on a canvas; null where there is no WebGL 2. */
function viewer(canvas) {
  const gl = canvas.getContext("webgl2", { antialias: false, premultipliedAlpha: true, preserveDrawingBuffer: true });
  if (!gl || typeof DecompressionStream === "undefined") return null;
  const look = { ...START };
  let program = prepared(gl);
  let shape = null;
  let frame = 0;
  let rest = 0;

  function render(samples) {
    if (!shape) return;
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const side = Math.max(1, Math.round(canvas.clientWidth * ratio));
    if (canvas.width !== side) canvas.width = canvas.height = side;
    gl.viewport(0, 0, side, side);
    gl.uniform2f(program.size, side, side);
    gl.uniform1i(program.samples, samples);
    gl.uniform1f(program.half_, 0.5 * Math.hypot(...atlas.volume.box) * 0.95 / look.zoom);
    gl.uniform1f(program.fog, dark.matches ? 0.2 : 0.93);
    for (const [name, value] of Object.entries(frameOf(look))) gl.uniform3f(program[name], ...value);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
    canvas.dataset.drawn = `${atlas.ids[shape.k]} ${Math.round(look.azimuth)} ${Math.round(look.elevation)} ${look.zoom.toFixed(2)}`;
  }

  /** A quick picture now, a smooth one when nothing has moved for a while. */
  function turn() {
    cancelAnimationFrame(frame);
    clearTimeout(rest);
    frame = requestAnimationFrame(() => render(1));
    rest = setTimeout(() => render(4), REST_MS);
  }

  canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
  canvas.addEventListener("webglcontextrestored", () => {
    program = prepared(gl);
    if (shape) load(gl, program, shape.data);
    turn();
  });
  handled(canvas, look, turn);
  new ResizeObserver(turn).observe(canvas);
  dark.addEventListener("change", turn);
  return async (k) => {
    const data = doubled(await volume(k));
    shape = { k, data };
    load(gl, program, data);
    turn();
  };
}

function prepared(gl) {
  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) throw new Error(gl.getProgramInfoLog(program));
  gl.useProgram(program);
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]), gl.STATIC_DRAW);
  gl.enableVertexAttribArray(0);
  gl.vertexAttribPointer(0, 2, gl.FLOAT, false, 0, 0);
  const names = "size samples half_ fog box voxel level slope cut right up towards light".split(" ");
  return Object.fromEntries(names.map((name) => [name, gl.getUniformLocation(program, name)]));
}

/** Put a volume of twice `atlas.volume.shape` on the card; the box repeats. */
function load(gl, program, data) {
  const [depth, height, width] = atlas.volume.shape.map((n) => 2 * n);
  const [bz, by, bx] = atlas.volume.box;
  gl.bindTexture(gl.TEXTURE_3D, gl.createTexture());
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  gl.texImage3D(gl.TEXTURE_3D, 0, gl.R8, width, height, depth, 0, gl.RED, gl.UNSIGNED_BYTE, data);
  gl.texParameteri(gl.TEXTURE_3D, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_LINEAR);
  gl.generateMipmap(gl.TEXTURE_3D);
  gl.uniform3f(program.box, bx, by, bz);
  gl.uniform3f(program.voxel, bx / width, by / height, bz / depth);
  gl.uniform1f(program.slope, atlas.volume.slope);
  gl.uniform1f(program.cut, atlas.volume.cut);
  gl.uniform1f(program.level, 0.5 * STEP * atlas.volume.levels / 255);
}

/** Grey values a level of the stored volume is worth. */
const STEP = Math.floor(255 / atlas.volume.levels);

/** A periodic volume with a value halfway between any two, by cubic interpolation along one axis after another. */
function doubled(data) {
  let shape = atlas.volume.shape;
  let now = Float32Array.from(data, (value) => value * STEP);
  for (const axis of [0, 1, 2]) {
    const n = shape[axis];
    const inner = shape.slice(axis + 1).reduce((product, m) => product * m, 1);
    const next = new Float32Array(2 * now.length);
    const outer = now.length / (n * inner);
    for (let o = 0; o < outer; o++) {
      for (let i = 0; i < n; i++) {
        const [a, b, c, d] = [i + n - 1, i, i + 1, i + 2].map((at) => (o * n + (at % n)) * inner);
        const to = (o * 2 * n + 2 * i) * inner;
        for (let k = 0; k < inner; k++) {
          next[to + k] = now[b + k];
          next[to + inner + k] = (9 * (now[b + k] + now[c + k]) - now[a + k] - now[d + k]) / 16;
        }
      }
    }
    now = next;
    shape = shape.map((m, k) => (k === axis ? 2 * m : m));
  }
  return Uint8Array.from(now, (value) => Math.min(255, Math.max(0, Math.round(value))));
}

/** The picture's directions in the box (x, y, z), and the light's: those of the package's pictures. */
function frameOf({ azimuth, elevation }) {
  const [a, b] = [azimuth, elevation].map((angle) => (angle * Math.PI) / 180);
  const right = [Math.cos(a), Math.sin(a), 0];
  const up = [-Math.sin(a) * Math.sin(b), Math.cos(a) * Math.sin(b), Math.cos(b)];
  const towards = [Math.sin(a) * Math.cos(b), -Math.cos(a) * Math.cos(b), Math.sin(b)];
  const light = [0, 1, 2].map((k) => (-0.42 * right[k] + 0.68 * up[k] + 0.6 * towards[k]) / Math.hypot(0.42, 0.68, 0.6));
  return { right, up, towards, light };
}
