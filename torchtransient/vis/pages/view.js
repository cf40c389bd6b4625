// The page of `tt.vis.view`: reads codes, turns them into pictures and curves, and follows the controls.
"use strict";
(() => {
  const meta = JSON.parse(document.getElementById("meta").textContent);
  const [T, H, W] = meta.shape;
  const N = H * W, K = meta.channels, stride = meta.stride;
  const GREY = 0xff888888, MAGENTA = 0xffff00ff;
  const centers = meta.slider.centers;
  const complex = "phase" in meta.tables, polarized = "s1" in meta.tables;
  const pair = meta.items === 2 && meta.pair;

  // ------------------------------------------------------------------------------------------------- numbers
  // A store gives codes: of a bin, frame(entry, plane, t), and of a pixel over all bins, curve(entry, plane, i).

  const tables = {}, wide = new Set();
  for (const [name, values] of Object.entries(meta.tables)) {
    if (values === "counts") {  // sixteen bits, whose last code is what is not finite
      wide.add(name);
      tables[name] = Float32Array.from({ length: 65536 }, (_, i) => (i === 65535 ? NaN : i));
    } else {
      tables[name] = Float32Array.from(values, (v) => (v === null ? NaN : v));
    }
  }

  async function unpacked(id) {
    const text = atob(document.getElementById(id).textContent);
    const bytes = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    return new Uint8Array(await new Response(stream).arrayBuffer());
  }

  class Inline {
    constructor() { this.kept = new Map(); }

    plane(entry, name) {
      const id = `codes-${entry}-${name}`, typed = (bytes) => (wide.has(name) ? new Uint16Array(bytes.buffer) : bytes);
      if (!this.kept.has(id)) this.kept.set(id, unpacked(id).then(typed));
      return this.kept.get(id);
    }

    async frame(entry, name, t) { return (await this.plane(entry, name)).subarray(t * N, (t + 1) * N); }

    async curve(entry, name, i) {
      const codes = await this.plane(entry, name), found = new codes.constructor(T);
      for (let t = 0; t < T; t++) found[t] = codes[t * N + i];
      return found;
    }
  }

  class Served {  // the upper halves of float32, read from the server
    constructor() {
      const bits = new Uint32Array(65536);
      for (let i = 0; i < 65536; i++) bits[i] = i << 16;
      for (const name of Object.keys(tables)) tables[name] = new Float32Array(bits.buffer);
    }

    async read(what, type = Uint16Array) {
      const answer = await fetch(`${meta.server}/${what}`);
      if (!answer.ok) throw new Error(`the server said ${answer.status}: ${await answer.text()}`);
      return new type(await answer.arrayBuffer());
    }

    frame(entry, name, t) { return this.read(`frame/${entry}/${name}/${t}`); }
    curve(entry, name, i) { return this.read(`curve/${entry}/${name}/${Math.floor(i / W) * stride}/${(i % W) * stride}`); }
  }

  const store = meta.server ? new Served() : new Inline();
  const lights = Array.from({ length: K }, (_, k) => `c${k}`);

  // Linear parts of the light that can be added up: channels; S0 to S3; real and imaginary part.
  const partsCount = complex ? 2 : polarized ? 4 : K;
  const emptyParts = (size) => Array.from({ length: partsCount }, () => new Float32Array(size));

  function addParts(parts, codes, size) {
    if (complex) {
      for (let i = 0; i < size; i++) {
        const a = tables.c0[codes[0][i]], p = tables.phase[codes[1][i]];
        parts[0][i] += a * Math.cos(p);
        parts[1][i] += a * Math.sin(p);
      }
    } else if (polarized) {
      for (let i = 0; i < size; i++) {
        const s0 = tables.c0[codes[0][i]];
        parts[0][i] += s0;
        for (let k = 1; k < 4; k++) parts[k][i] += s0 * tables.s1[codes[k][i]];
      }
    } else {
      for (let k = 0; k < K; k++) {
        const table = tables[`c${k}`], part = parts[k], code = codes[k];
        for (let i = 0; i < size; i++) part[i] += table[code[i]];
      }
    }
    return parts;
  }

  const planeNames = complex ? ["c0", "phase"] : polarized ? ["c0", "s1", "s2", "s3"] : lights;
  const frameCodes = (entry, t) => Promise.all(planeNames.map((name) => store.frame(entry, name, t)));

  const state = {
    t: 0, mode: meta.modes[0], map: "inferno", curve: "linear", exposure: 0, accumulate: false, item: 0,
    layer: meta.layers > 1 ? (meta.layerGrid.length ? Math.floor(meta.layers / 2) : meta.kind === "rates" ? "all" : 0) : 0,
    pixels: [], playing: false, logAxis: false,
  };

  const entriesOf = (item) => {
    const first = item * meta.layers;
    if (state.layer === "all") return Array.from({ length: meta.layers }, (_, n) => first + n);
    return [first + state.layer];
  };

  const sums = {};  // running sums over bins, by item

  async function partsOf(item, t) {
    const entries = entriesOf(item), key = entries.join();
    let from = t, parts = null;
    if (state.accumulate) {
      const held = sums[item];
      if (held && held.key === key && held.t <= t) [parts, from] = [held.parts, held.t + 1];
      else from = 0;
    }
    parts = parts ?? emptyParts(N);
    for (let bin = from; bin <= t; bin++) {
      for (const entry of entries) addParts(parts, await frameCodes(entry, bin), N);
    }
    if (state.accumulate) sums[item] = { key, t, parts };
    return parts;
  }

  // ------------------------------------------------------------------------------------------------ modes
  // A picture of one number a pixel, and the scale that it has.

  const light = (parts, i) => {
    if (complex) return Math.hypot(parts[0][i], parts[1][i]);
    if (polarized || K === 1) return parts[0][i];
    return (parts[0][i] + parts[1][i] + parts[2][i]) / 3;
  };
  const DEGREES = 180 / Math.PI;
  const perPixel = {
    light,
    dop: (p, i) => (p[0][i] > 0 ? Math.min(1, Math.hypot(p[1][i], p[2][i], p[3][i]) / p[0][i]) : NaN),
    // Below the error of the ratios light may be without linear polarization, which has no angle.
    aolp: (p, i) => (Math.hypot(p[1][i], p[2][i]) > (tables.s1[128] / Math.SQRT2) * p[0][i] ? 0.5 * DEGREES * Math.atan2(p[2][i], p[1][i]) : NaN),
    real: (p, i) => p[0][i],
    phase: (p, i) => (p[0][i] || p[1][i] ? DEGREES * Math.atan2(p[1][i], p[0][i]) : NaN),
  };
  const overBins = new Set(["peak", "rainbow", "speed"]);
  const kept = new Map();  // results over all bins

  async function kept_(key, make) {
    if (!kept.has(key)) kept.set(key, make());
    return kept.get(key);
  }

  // Centre of the brightest bin of each pixel, and its total.
  const peaksOf = (item) => kept_(`peak ${item} ${state.layer}`, async () => {
    if (meta.server) {
      write("where", "reading the whole file ...");
      const both = await store.read("peaks", Float32Array);
      return { peak: both.subarray(0, N), total: both.subarray(N) };
    }
    const peak = new Float32Array(N).fill(NaN), most = new Float32Array(N), total = new Float32Array(N);
    const entries = entriesOf(item);
    for (let t = 0; t < T; t++) {
      let frame;
      for (const entry of entries) {
        const codes = await frameCodes(entry, t);
        if (K === 1 && entries.length === 1) {
          const code = codes[0], table = tables.c0;
          for (let i = 0; i < N; i++) {
            const v = table[code[i]];
            if (v > most[i]) { most[i] = v; peak[i] = centers[t]; }
            total[i] += v;
          }
        } else {
          frame = addParts(frame ?? emptyParts(N), codes, N);
        }
      }
      for (let i = 0; frame && i < N; i++) {
        const v = light(frame, i);
        if (v > most[i]) { most[i] = v; peak[i] = centers[t]; }
        total[i] += v;
      }
    }
    for (let i = 0; i < N; i++) if (!Number.isFinite(total[i])) peak[i] = NaN;
    return { peak, total };
  });

  // Speed of approach: minus half the mean rate.
  const speedsOf = (item) => kept_(`speed ${item}`, async () => {
    const total = new Float64Array(N), moment = new Float64Array(N);
    for (let n = 0; n < meta.layers; n++) {
      const codes = await store.plane(item * meta.layers + n, "c0");
      for (let j = 0; j < codes.length; j++) {
        const v = tables.c0[codes[j]], i = j % N;
        total[i] += v;
        moment[i] += v * meta.layerNumbers[n];
      }
    }
    return Float32Array.from(total, (v, i) => (v > 0 ? -moment[i] / v / 2 : NaN));
  });

  async function scalarOf(item, mode, t) {
    if (mode === "peak" || mode === "rainbow") return (await peaksOf(item)).peak;
    if (mode === "speed") return speedsOf(item);
    const parts = await partsOf(item, t), value = perPixel[mode === "colour" ? "light" : mode];
    const found = new Float32Array(N);
    for (let i = 0; i < N; i++) found[i] = value(parts, i);
    return found;
  }

  const sortedSizes = (values) => Float32Array.from(values, Math.abs).filter((v) => v > 0 && isFinite(v)).sort();
  const quantile = (values, share, otherwise) => {
    const sorted = sortedSizes(values);
    return sorted.length ? sorted[Math.min(sorted.length - 1, Math.floor(share * sorted.length))] : otherwise;
  };

  // Brightness that is white: all frames have one, single bins and sums over bins each their own.
  const whiteOf = () => kept_(`white ${state.accumulate} ${state.layer}`, async () => {
    if (state.accumulate) return quantile((await peaksOf(0)).total, 0.99, 1);
    const found = [];
    const step = Math.max(1, Math.floor(N / 4096)), every = Math.max(1, Math.floor(T / (meta.server ? 3 : 64)));
    for (let t = meta.server ? meta.start : 0; t < T; t += every) {
      const parts = emptyParts(N);
      for (const entry of entriesOf(0)) addParts(parts, await frameCodes(entry, t), N);
      for (let i = 0; i < N; i += step) found.push(light(parts, i));
      if (meta.server) break;
    }
    return quantile(found, 0.99, 1);
  });

  async function scaleOf(mode, item, values) {
    const signs = { palette: mode === "speed" && item !== "difference" ? "approach" : "diverging", log: false };
    if (mode === "aolp") return { palette: "cyclic", low: -90, high: 90, log: false, cyclic: true };
    if (mode === "phase") return { palette: "cyclic", low: -180, high: 180, log: false, cyclic: true };
    if (item === "difference" || mode === "speed" || mode === "real" || (meta.signed && mode === "light")) {
      const overall = item !== "difference" && mode !== "speed" ? await whiteOf() : quantile(values, 0.99, 1);
      const half = overall / 2 ** state.exposure;
      return { ...signs, low: -half, high: half };
    }
    if (mode === "dop") return { palette: state.map, low: 0, high: 1, log: false };
    if (mode === "peak" || mode === "rainbow") {
      const known = values.filter(isFinite).sort();
      const at = (share) => known[Math.floor(share * (known.length - 1))] ?? centers[0];
      const [low, high] = [at(0.01), at(0.99)];
      return { palette: mode === "peak" ? state.map : "rainbow", low, high: high > low ? high : low + 1, log: false };
    }
    const high = (await whiteOf()) / 2 ** state.exposure;
    const log = state.curve === "logarithmic";
    return { palette: state.map, low: log ? high * 1e-4 : 0, high, log };
  }

  // ----------------------------------------------------------------------------------------------- drawing

  const rgba = (hex) => {
    const v = parseInt(hex.slice(1), 16);
    return (0xff000000 | ((v & 255) << 16) | (v & 0xff00) | (v >> 16)) >>> 0;
  };
  const palettes = {};
  const toByte = (x) => {
    const v = x <= 0 ? 0 : x >= 1 ? 1 : x;
    return Math.round(255 * (v <= 0.0031308 ? 12.92 * v : 1.055 * v ** (1 / 2.4) - 0.055));
  };
  // The bar of pictures in colour: greys as bright as the light.
  meta.maps.screen = Array.from({ length: 256 }, (_, i) => `#${toByte(i / 255).toString(16).padStart(2, "0").repeat(3)}`);
  for (const [name, colours] of Object.entries(meta.maps)) palettes[name] = Uint32Array.from(colours, rgba);

  const shareOf = (v, scale) => (scale.log ? Math.log(v / scale.low) / Math.log(scale.high / scale.low)
    : (v - scale.low) / (scale.high - scale.low));

  function paint(target, values, scale, dark) {
    const palette = palettes[scale.palette], last = palette.length - 1;
    for (let i = 0; i < values.length; i++) {
      const v = values[i];
      if (!Number.isFinite(v)) { target[i] = dark; continue; }
      const x = scale.log && v <= 0 ? 0 : shareOf(v, scale);
      target[i] = palette[scale.cyclic ? Math.floor(x * last + 0.5) & 255 : x <= 0 ? 0 : x >= 1 ? last : Math.floor(x * last + 0.5)];
    }
  }

  const byteOf = (v, scale) => {
    if (!Number.isFinite(v)) return 255;
    if (!scale.log) return toByte(v / scale.high);
    return v <= 0 ? 0 : Math.round(255 * Math.min(1, Math.max(0, shareOf(v, scale))));
  };

  let bytes = { key: "" };  // bytes of each code

  function bytesOf(scale) {
    const key = `${scale.log} ${scale.low} ${scale.high}`;
    if (bytes.key !== key) bytes = { key, lut: Uint8Array.from(tables.c0, (v) => byteOf(v, scale)) };
    return bytes.lut;
  }

  async function paintColour(target, scale) {
    const entries = entriesOf(state.item);
    let r, g, b, lut;
    if (!state.accumulate && entries.length === 1) {
      [[r, g, b], lut] = [await frameCodes(entries[0], state.t), bytesOf(scale)];
      for (let i = 0; i < N; i++) target[i] = 0xff000000 | (lut[b[i]] << 16) | (lut[g[i]] << 8) | lut[r[i]];
      return;
    }
    [r, g, b] = await partsOf(state.item, state.t);
    for (let i = 0; i < N; i++) {
      target[i] = 0xff000000 | (byteOf(b[i], scale) << 16) | (byteOf(g[i], scale) << 8) | byteOf(r[i], scale);
    }
  }

  let coloured = { key: "" };  // colours of each code

  async function paintCodes(target, scale) {
    const key = `${scale.palette} ${scale.log} ${scale.low} ${scale.high}`;
    if (coloured.key !== key) {
      coloured = { key, lut: new Uint32Array(tables.c0.length) };
      paint(coloured.lut, tables.c0, scale, MAGENTA);
    }
    const codes = await store.frame(entriesOf(state.item)[0], "c0", state.t), lut = coloured.lut;
    for (let i = 0; i < N; i++) target[i] = lut[codes[i]];
  }

  async function paintRainbow(target, scale) {
    const { peak, total } = await peaksOf(state.item === "difference" ? 0 : state.item);
    const white = quantile(total, 0.99, 1) / 2 ** state.exposure;
    paint(target, peak, scale, 0xff000000);
    for (let i = 0; i < N; i++) {
      const f = toByte(total[i] / white) / 255, c = target[i];
      target[i] = 0xff000000 | (((c >> 16) & 255) * f << 16) | (((c >> 8) & 255) * f << 8) | ((c & 255) * f);
    }
  }

  let doc = null;
  const model = (name) => doc.get_model_by_name(name);
  // Texts that change with every bin, past bokeh, which would lay out the whole page anew.
  const write = (name, html) => {
    window.Bokeh.index.find_one(model(name)).shadow_el.querySelector(".own").innerHTML = html;
  };
  const image = (name) => { const array = model(name).data.image[0]; return array.length === undefined ? array.data : array; };

  let shown = null;  // values of the picture, for the readout

  let drawn = "";  // what a picture over all bins was drawn for

  async function drawPicture() {
    const { t: _, pixels, playing, logAxis, ...rest } = state, key = JSON.stringify(rest);
    if (overBins.has(state.mode) && drawn === key) return;
    drawn = key;
    const target = image("image"), { mode, item, t } = state;
    let scale;
    const plain = item !== "difference" && !meta.signed && entriesOf(item).length === 1;
    if (mode === "colour" && item !== "difference" && !meta.signed) {
      scale = await scaleOf("light", item, null);
      await paintColour(target, scale);
      shown = null;
    } else if (plain && mode === "light" && partsCount !== 3 && !state.accumulate) {
      scale = await scaleOf("light", item, null);
      await paintCodes(target, scale);
      shown = null;
    } else if (mode === "rainbow" && item !== "difference") {
      shown = await scalarOf(item, mode, t);
      scale = await scaleOf(mode, item, shown);
      await paintRainbow(target, scale);
    } else {
      const single = mode === "colour" ? "light" : mode;
      shown = await scalarOf(item === "difference" ? 0 : item, single, t);
      if (item === "difference") {
        const other = await scalarOf(1, single, t), period = { aolp: 180, phase: 360 }[single];
        shown = shown.map((v, i) => (period ? v - other[i] - period * Math.round((v - other[i]) / period) : v - other[i]));
      }
      scale = await scaleOf(single, item, shown);
      paint(target, shown, scale, single === "light" ? MAGENTA : GREY);
    }
    model("image").change.emit();
    drawBar(scale, mode === "colour" && item !== "difference" && !meta.signed ? (scale.log ? "grey" : "screen") : scale.palette);
  }

  let barKey = "";

  function drawBar(scale, palette) {
    const key = `${palette} ${scale.log} ${scale.low} ${scale.high}`;
    if (key === barKey) return;
    barKey = key;
    const bar = model(scale.log ? "bar_log" : "bar_linear");
    const colours = meta.maps[palette];
    bar.setv({ low: scale.low, high: scale.high, palette: scale.cyclic ? colours.slice() : colours });
    model("colorbar_linear").visible = !scale.log;
    model("colorbar_log").visible = scale.log;
  }

  const number = (v) => (Number.isFinite(v) ? (v !== 0 && (Math.abs(v) >= 1e4 || Math.abs(v) < 1e-3) ? v.toExponential(3)
    : v.toPrecision(4)) : "none");

  function placeText(t) {
    const { name, unit, second, secondUnit, factor } = meta.slider;
    const label = meta.slider.labels[t];
    const along = label ? `${name} ${label}` : unit || second ? `${name} ${number(centers[t])} ${unit}`
      : centers[t] === t ? "" : `${name} ${centers[t]}`;
    return `<b>${t}</b> of 0 to ${T - 1}${along && ": "}${along}${second ? ` = ${number(centers[t] * factor)} ${secondUnit}` : ""}`;
  }

  // ------------------------------------------------------------------------------------------------ curves

  async function curveOf(item, i) {
    const parts = emptyParts(T), errors = "error" in tables && !meta.server ? new Float32Array(T) : null;
    for (const entry of entriesOf(item)) {
      addParts(parts, await Promise.all(planeNames.map((name) => store.curve(entry, name, i))), T);
      if (errors) (await store.curve(entry, "error", i)).forEach((code, t) => { errors[t] = tables.error[code]; });
    }
    const value = complex ? perPixel[state.mode] : light;
    return { parts, y: Float32Array.from(centers, (_, t) => value(parts, t)), errors };
  }

  let curves = [];
  const most = () => (pair && state.item !== "difference" ? 2 : 4);

  async function drawCurves() {
    curves = [];
    for (const pixel of state.pixels.slice(-most())) {
      const i = pixel.row * W + pixel.column;
      if (state.item === "difference") {
        const [a, b] = [await curveOf(0, i), await curveOf(1, i)];
        const errors = a.errors && b.errors ? a.errors.map((e, t) => Math.hypot(e, b.errors[t])) : null;
        curves.push({ pixel, name: "A − B", y: a.y.map((v, t) => v - b.y[t]), errors });
      } else if (pair) {
        for (const item of [0, 1]) curves.push({ pixel, name: "AB"[item], ...(await curveOf(item, i)) });
      } else {
        curves.push({ pixel, name: "", ...(await curveOf(state.item, i)) });
      }
    }
    const x = Float64Array.from(centers);
    let low = Infinity, high = 0, bottom = 0;
    for (let n = 0; n < 4; n++) {
      const curve = curves[n], floor = state.logAxis ? 1e-300 : -Infinity;
      const side = (sign) => (curve && curve.errors ? Float64Array.from(curve.y, (v, t) => Math.max(floor, v + sign * 2 * curve.errors[t])) : []);
      const y = curve ? Float64Array.from(curve.y, (v) => (state.logAxis && v <= 0 ? NaN : v)) : [];
      const upper = side(1);
      model(`curve_${n}`).data = { x: curve ? x : [], y, low: upper.length ? side(-1) : Array.from(y, () => NaN), high: upper.length ? upper : Array.from(y, () => NaN) };
      if (!curve) continue;
      for (let t = 0; t < T; t++) {
        const v = curve.y[t];
        if (v > 0) low = Math.min(low, v);
        if (Number.isFinite(v)) [high, bottom] = [Math.max(high, v, upper[t] ?? 0), Math.min(bottom, v)];
      }
    }
    high = high > 0 ? high : 1;
    if (complex) {
      const label = { light: "amplitude", real: "real part", phase: "phase (degrees)" }[state.mode];
      for (const name of ["histogram", "histogram_log"]) model(name).left[0].axis_label = label;
    }
    model("histogram").y_range.setv({ start: bottom < 0 ? 1.08 * bottom : 0, end: 1.08 * high });
    model("histogram_log").y_range.setv({ start: Math.max(low, high * 1e-6) / 2, end: 2 * high });
    await drawSides();
    drawReadout();
  }

  const COLOURS = ["#0072B2", "#E69F00", "#009E73", "#CC79A7"];

  function drawMarkers() {
    const [left, right, low, high] = meta.extent ?? [0, W * stride, 0, H * stride];
    const chosen = state.pixels.slice(-most());
    model("pixels").data = {
      x: chosen.map((p) => left + ((p.column + 0.5) / W) * (right - left)),
      y: chosen.map((p) => low + ((p.row + 0.5) / H) * (high - low)),
      colour: chosen.map((_, n) => COLOURS[pair && state.item !== "difference" ? 2 * n : n]),
    };
  }

  function valueNow({ pixel, parts, y }) {
    const i = pixel.row * W + pixel.column;
    if (overBins.has(state.mode)) return shown ? shown[i] : NaN;
    if (!parts || state.mode === "light" || state.mode === "colour") {
      return state.accumulate ? y.slice(0, state.t + 1).reduce((a, b) => a + b, 0) : y[state.t];
    }
    if (!state.accumulate) return perPixel[state.mode](parts, state.t);
    const summed = parts.map((part) => [part.slice(0, state.t + 1).reduce((a, b) => a + b, 0)]);
    return perPixel[state.mode](summed, 0);
  }

  const positionText = (t) => meta.slider.labels[t] ?? `${number(centers[t])} ${meta.slider.unit}`;

  // Rows and columns of the result.
  function placeOf({ row, column }) {
    const named = (name, first) => (meta.block === 1 ? `${name} ${first}` : `${name}s ${first}-${first + meta.block - 1}`);
    return `${named("row", row * stride)}, ${named("column", column * stride)}`;
  }

  function drawReadout() {
    const units = { dop: "", aolp: " °", phase: " °", peak: ` ${meta.slider.unit}`, rainbow: ` ${meta.slider.unit}`, speed: " m/s" };
    const unit = units[state.mode] ?? "";
    const rows = curves.map((curve, n) => {
      const total = curve.y.reduce((a, b) => a + b, 0);
      const top = curve.y.reduce((best, v, t) => (v > curve.y[best] ? t : best), 0);
      const error = curve.errors && !state.accumulate && ["light", "colour"].includes(state.mode) ? ` ± ${number(curve.errors[state.t])}` : "";
      return `<tr class="pixel"><td style="color:${COLOURS[n]}">■</td><td>${curve.name} ${placeOf(curve.pixel)}</td>`
        + `<td class="value">${number(valueNow(curve))}${error}${unit}</td><td class="sum">${complex ? "" : number(total)}</td>`
        + `<td class="at">${curve.y.every(Number.isFinite) ? positionText(top) : "none"}</td></tr>`;
    });
    write("readout", `<table cellpadding="4" style="font-size:13px"><tr><th></th><th>pixel</th><th>at the cursor${curves.some((curve) => curve.errors) ? " (± one standard error)" : ""}</th><th>${complex ? "" : "sum"}</th><th>highest at</th></tr>${rows.join("")}</table>`
      + `<div style="color:#555;margin-top:4px">Click: a pixel more, or one less. Drag a ring to move it. Space: play. Arrows: one step (shift: ten). Home, End. Click the histogram to go there.</div>`);
  }

  // ----------------------------------------------------------------------------------- other views of a kind

  async function drawSides() {
    if (meta.kind === "rates" && state.pixels.length) {
      const { row, column } = state.pixels[state.pixels.length - 1], target = image("rate_map");
      const values = new Float32Array(T * meta.layers);
      for (let n = 0; n < meta.layers; n++) {
        const codes = await store.curve((state.item === "difference" ? 0 : state.item) * meta.layers + n, "c0", row * W + column);
        for (let t = 0; t < T; t++) values[t * meta.layers + n] = tables.c0[codes[t]];
      }
      const high = quantile(values, 1, 1);
      paint(target, values, { palette: state.map, low: high * 1e-4, high, log: true }, GREY);
      model("rate_map").change.emit();
    }
    if (meta.layerGrid.length) {
      const n = Number(state.layer), columns = meta.layerGrid[1];
      model("spot").data = { x: [n % columns], y: [Math.floor(n / columns)] };
      if (meta.marks.length) model("laser").data = { x: [meta.marks[n][0]], y: [meta.marks[n][1]] };
    }
    if (meta.kind === "volume") await drawVolume();
  }

  async function drawVolume() {
    const codes = await store.plane(state.item === "difference" ? 0 : state.item, "c0"), table = tables.c0;
    const scale = await scaleOf("light", 0, null);
    const { row, column } = state.pixels[state.pixels.length - 1] ?? { row: H >> 1, column: W >> 1 };
    const above = new Float32Array(T * W), side = new Float32Array(H * T);
    for (let z = 0; z < T; z++) {
      for (let x = 0; x < W; x++) above[z * W + x] = table[codes[z * N + row * W + x]];
      for (let y = 0; y < H; y++) side[y * T + z] = table[codes[z * N + y * W + column]];
    }
    paint(image("slice_above"), above, scale, MAGENTA);
    paint(image("slice_side"), side, scale, MAGENTA);
    model("slice_above").change.emit();
    model("slice_side").change.emit();
    drawTurning(codes, table);
  }

  let solid = { key: "" };  // voxels above the threshold

  function drawTurning(codes, table) {
    const threshold = model("threshold").value, top = table.reduce((a, b) => (b > a ? b : a), 0);
    const key = `${state.item} ${threshold}`;
    if (solid.key !== key) {
      const found = [];
      for (let j = 0; j < codes.length; j++) if (table[codes[j]] > Math.max(0, threshold * top)) found.push(j);
      solid = { key, found };
    }
    const [left, right, low, high] = meta.extent, depth = T > 1 ? centers[T - 1] - centers[0] : 1;
    const size = 160, angle = (model("turn").value * Math.PI) / 180, [c, s] = [Math.cos(angle), Math.sin(angle)];
    const unit = size / Math.hypot(right - left, high - low, depth), values = new Float32Array(size * size);
    const dot = Math.max(1, Math.ceil(unit * Math.max((right - left) / W, (high - low) / H)));
    for (const j of solid.found) {
      const x = (((j % W) + 0.5) / W - 0.5) * (right - left), y = ((Math.floor((j % N) / W) + 0.5) / H - 0.5) * (high - low);
      const z = (T > 1 ? centers[Math.floor(j / N)] - centers[0] : 0) - depth / 2;
      const u = Math.round(size / 2 + unit * (x * c + z * s) - dot / 2), v = Math.round(size / 2 + unit * y - dot / 2);
      const value = table[codes[j]];
      for (let a = 0; a < dot; a++) {
        for (let b = 0; b < dot; b++) {
          const p = (v + b) * size + u + a;
          if (u + a >= 0 && u + a < size && value > values[p]) values[p] = value;
        }
      }
    }
    paint(image("turning"), values, { palette: state.map, low: 0, high: top || 1, log: false }, MAGENTA);
    model("turning").change.emit();
  }

  // ---------------------------------------------------------------------------------------------- controls

  let busy = false, again = null;

  // Draw what `state` says; calls while one is at work become one more.
  async function refresh(all) {
    if (busy) { again = again || all; if (again === null) again = all; return; }
    busy = true;
    try {
      let everything = all;
      do {
        again = null;
        await drawPicture();
        model(`cursor_${Number(state.logAxis)}`).location = centers[state.t];
        write("where", placeText(state.t));
        if (everything) { drawMarkers(); await drawCurves(); } else drawReadout();
        everything = again;
      } while (again !== null);
      page.drawn += 1;
    } catch (error) {
      write("where", `<b style="color:#a00">${String(error)}</b>`);
      throw error;
    } finally {
      busy = false;
    }
  }

  function go(t) {
    const wanted = Math.max(0, Math.min(T - 1, Math.round(t)));
    if (wanted === state.t && model("slider").value === wanted) return Promise.resolve();
    state.t = wanted;
    if (model("slider").value !== wanted) model("slider").value = wanted;
    return refresh(false);
  }

  function play(on) {
    state.playing = on;
    model("play").label = on ? "❚❚ pause" : "▶ play";
    if (on) requestAnimationFrame(step);
  }

  const FRAME_MS = 33;
  let last = 0;

  async function step(now) {
    if (!state.playing) return;
    if (now - last >= FRAME_MS - 4) {
      last = now;
      await go(state.t + 1 < T ? state.t + 1 : 0);
    }
    requestAnimationFrame(step);
  }

  const pixelAt = (x, y) => {
    const [left, right, low, high] = meta.extent ?? [0, W * stride, 0, H * stride];
    const column = Math.floor(((x - left) / (right - left)) * W), row = Math.floor(((y - low) / (high - low)) * H);
    return row >= 0 && row < H && column >= 0 && column < W ? { row, column } : null;
  };
  const near = (p) => {
    const reach = Math.max(0, Math.floor(0.02 * Math.max(H, W)));
    return state.pixels.findIndex((q) => Math.abs(p.row - q.row) <= reach && Math.abs(p.column - q.column) <= reach);
  };
  let dragged = null;

  const page = window.torchtransient = {
    drawn: 0, ready: false, state,
    go, play,
    tap(x, y) {
      const pixel = pixelAt(x, y);
      if (!pixel) return;
      const held = near(pixel);
      if (held >= 0 && state.pixels.length > 1) state.pixels.splice(held, 1);
      else if (held < 0) state.pixels = [...state.pixels, pixel].slice(-most());
      refresh(true);
    },
    drag(what, x, y) {
      const pixel = pixelAt(x, y);
      if (what === "panstart") dragged = pixel && near(pixel) >= 0 ? near(pixel) : null;
      if (dragged !== null && pixel) {
        state.pixels[dragged] = pixel;
        refresh(true);
      }
      if (what === "panend") dragged = null;
    },
    scrub(x) {
      let best = 0;
      centers.forEach((c, t) => { if (Math.abs(c - x) < Math.abs(centers[best] - x)) best = t; });
      go(best);
    },
    spot(x, y) {
      const [rows, columns] = meta.layerGrid, column = Math.round(x), row = Math.round(y);
      if (row >= 0 && row < rows && column >= 0 && column < columns) model("layer").value = String(row * columns + column);
    },
  };

  const follow = (name, property, change, all = true) => {
    const found = model(name);
    if (found) found.properties[property].change.connect(() => { change(found[property]); refresh(all); });
  };

  function connect() {
    model("slider").properties.value.change.connect(() => go(model("slider").value));
    model("play").on_event("button_click", () => play(!state.playing));
    follow("mode", "value", (v) => { state.mode = v; }, complex);
    follow("map", "value", (v) => { state.map = v; });
    follow("curve", "value", (v) => { state.curve = v; });
    follow("exposure", "value", (v) => { state.exposure = v; });
    follow("accumulate", "active", (v) => { state.accumulate = v; }, false);
    follow("log_axis", "active", (v) => {
      state.logAxis = v;
      model("histogram").visible = !v;
      model("histogram_log").visible = v;
    });
    follow("item", "value", (v) => { state.item = v === "difference" ? v : Number(v); });
    follow("layer", "value", (v) => { state.layer = v === "all" ? v : Number(v); });
    if (meta.kind === "volume") {
      follow("turn", "value", () => {});
      follow("threshold", "value", () => {});
      setInterval(() => { if (model("turns").active) model("turn").value = (model("turn").value + 5) % 360; }, 80);
    }
    document.addEventListener("keydown", (event) => {
      const inside = event.composedPath()[0];
      if (["SELECT", "INPUT", "TEXTAREA"].includes(inside.tagName) && inside.type !== "checkbox") return;
      const size = event.shiftKey ? 10 : 1;
      const moves = {
        " ": () => play(!state.playing), ArrowRight: () => go(state.t + size), ArrowLeft: () => go(state.t - size),
        Home: () => go(0), End: () => go(T - 1),
      };
      if (!moves[event.key]) return;
      event.preventDefault();
      event.stopPropagation();
      moves[event.key]();
    }, true);
  }

  // The bin in which most pixels see light (brightness counts by its logarithm), and a pixel of middling brightness in
  // it; of a volume, the brightest voxel.
  async function begin() {
    if (meta.kind === "volume") {
      const codes = await store.plane(0, "c0"), table = tables.c0;
      let best = 0;
      for (let j = 1; j < codes.length; j++) if (table[codes[j]] > table[codes[best]]) best = j;
      state.t = Math.floor(best / N);
    } else if (!meta.server) {
      let best = -1;
      const step = Math.max(1, Math.floor(N / 512));
      const frames = complex ? 1 : T, smallest = quantile(tables.c0, 0, 1);
      const weight = Float32Array.from(tables.c0, (v) => (Math.abs(v) > 0 ? 1 + Math.log(Math.abs(v) / smallest) : 0));
      for (let t = 0; t < frames; t++) {
        const codes = await store.frame(entriesOf(0)[entriesOf(0).length >> 1], "c0", t);
        let sum = 0;
        for (let i = 0; i < N; i += step) sum += weight[codes[i]];
        if (sum > best) [best, state.t] = [sum, t];
      }
    } else {
      state.t = meta.start;
    }
    const values = await scalarOf(0, "light", state.t);
    const lit = Array.from(values.keys()).filter((i) => values[i] > 0).sort((a, b) => values[a] - values[b]);
    const middle = lit.length ? lit[meta.kind === "volume" ? lit.length - 1 : lit.length >> 1] : (H >> 1) * W + (W >> 1);
    state.pixels = [{ row: Math.floor(middle / W), column: middle % W }];
  }

  async function start() {
    while (!(window.Bokeh && window.Bokeh.documents.length && window.Bokeh.documents[0].is_idle !== undefined
             && window.Bokeh.documents[0].get_model_by_name("root"))) {
      await new Promise((done) => setTimeout(done, 5));
    }
    doc = window.Bokeh.documents[0];
    await begin();
    connect();
    model("slider").value = state.t;
    await refresh(true);
    page.ready = true;
    page.readyAfter = performance.now();
  }

  if (!meta.server) for (const name of planeNames) store.plane(entriesOf(0)[0], name);
  start();
})();
