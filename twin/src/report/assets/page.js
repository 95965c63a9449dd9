// Draws the report's series and lets the reader zoom. Needs uPlot and the JSON in #series; fetches nothing.
(function () {
  "use strict";
  const signals = JSON.parse(document.getElementById("series").textContent);
  const root = document.documentElement;
  const colour = (name) => getComputedStyle(root).getPropertyValue("--" + name).trim();
  const plots = [];

  // A column is whole multiples of `s`, each as the difference to the one before; null is no value.
  function decode(column) {
    const out = new Array(column.d.length);
    // Dividing by a whole number rounds once; multiplying by 0.001 rounds twice.
    const inverse = column.s < 1 ? Math.round(1 / column.s) : 0;
    let now = 0;
    for (let k = 0; k < out.length; k++) {
      const step = column.d[k];
      if (step === null) { out[k] = null; continue; }
      now += step;
      out[k] = inverse ? now / inverse : now * column.s;
    }
    return out;
  }

  function number(value) {
    if (value === null || value === undefined || !isFinite(value)) return "–";
    if (value === 0) return "0";
    const size = Math.abs(value);
    const text = size >= 1e6 || size < 1e-4 ? value.toExponential(3) : String(+value.toPrecision(6));
    return text.replace(/^-/, "−");
  }

  function tick(value, step) {
    if (value === 0) return "0";
    const size = Math.abs(value);
    if (size >= 1e6 || size < 1e-4) return value.toExponential(Math.max(0, Math.min(3, Math.round(Math.log10(size / step))))).replace(/^-/, "−");
    let decimals = 0;
    while (decimals < 8 && Math.abs(step * 10 ** decimals - Math.round(step * 10 ** decimals)) > 1e-6 * step * 10 ** decimals) decimals++;
    return value.toFixed(decimals).replace(/^-/, "−");
  }

  function ticks(u, values) {
    const step = values.length > 1 ? Math.abs(values[1] - values[0]) || 1 : 1;
    return values.map((value) => (value === null ? "" : tick(value, step)));
  }

  // Of a logarithmic axis: 1 … 9 of each decade; over less than a decade even steps. uPlot's own need whole decades.
  function logSplits(u, index, min, max) {
    const out = [];
    if (max / min < 8) {
      const raw = (max - min) / 6, power = Math.pow(10, Math.floor(Math.log10(raw)));
      const step = [1, 2, 5, 10].map((k) => k * power).find((k) => k >= raw);
      for (let k = Math.ceil(min / step); k * step <= max && out.length < 50; k++) out.push(k * step);
      return out;
    }
    for (let power = Math.floor(Math.log10(min)); power <= Math.log10(max) && power < 308; power++) {
      for (let k = 1; k < 10; k++) {
        const value = k * Math.pow(10, power);
        if (value >= min * (1 - 1e-9) && value <= max * (1 + 1e-9)) out.push(value);
      }
    }
    return out;
  }
  function logTicks(u, values) {
    if (values.length > 1 && values[values.length - 1] / values[0] < 8) return ticks(u, values);
    const decades = Math.log10(values[values.length - 1] / values[0]);
    return values.map((value) => {
      if (value === null) return "";
      const power = Math.floor(Math.log10(value) + 1e-9), mantissa = Math.round(value / Math.pow(10, power));
      if (mantissa !== 1 && !(decades < 2 && (mantissa === 2 || mantissa === 5))) return "";
      return power >= -3 && power <= 4 ? String(+(mantissa * Math.pow(10, power)).toPrecision(1)) : mantissa + "e" + power;
    });
  }

  const font = "12px system-ui, -apple-system, 'Segoe UI', Roboto, Arial, 'DejaVu Sans', sans-serif";

  function axis(values, log) {
    return {
      font, values,
      stroke: () => colour("soft"),
      grid: { stroke: () => colour("grid"), width: 1 },
      ticks: { stroke: () => colour("grid"), width: 1 },
      filter: log ? (u, splits) => splits : undefined,
      splits: log ? logSplits : undefined,
    };
  }

  // As wide as its longest number, but plots over the same time stand exactly below each other.
  function yAxis(values, log, least) {
    const out = axis(values, log);
    out.size = (u, texts) => {
      if (!texts || !texts.length) return least;
      u.ctx.save();
      u.ctx.font = font;
      let widest = 0;
      for (const text of texts) widest = Math.max(widest, u.ctx.measureText(text || "").width);
      u.ctx.restore();
      return Math.max(least, Math.ceil(widest) + 18);
    };
    return out;
  }

  const line = (label, name, extra) => Object.assign({
    label, stroke: () => colour(name), width: 1.2, points: { show: false }, value: (u, v) => number(v), twinColour: name,
  }, extra);

  const dots = (label, name) => Object.assign(line(label, name), {
    width: 0, paths: () => null, twinGroup: name, class: "quiet",
    points: { show: true, size: 3, width: 0, stroke: () => clear(name, 0.4), fill: () => clear(name, 0.4) },
  });

  // A colour that lets what is under it through.
  function clear(name, opacity) {
    const n = parseInt(colour(name).slice(1), 16);
    return "rgba(" + (n >> 16) + "," + ((n >> 8) & 255) + "," + (n & 255) + "," + opacity + ")";
  }

  // The places that the report names, behind the lines.
  function shade(places) {
    return (u) => {
      if (!places.length) return;
      const ctx = u.ctx;
      ctx.save();
      ctx.beginPath();
      ctx.rect(u.bbox.left, u.bbox.top, u.bbox.width, u.bbox.height);
      ctx.clip();
      ctx.fillStyle = colour("shade");
      ctx.strokeStyle = colour("shade-edge");
      ctx.setLineDash([]);
      ctx.lineWidth = devicePixelRatio;
      for (const place of places) {
        const from = place.from === null ? u.bbox.left - 9 : u.valToPos(place.from, "x", true);
        const to = place.to === null ? u.bbox.left + u.bbox.width + 9 : u.valToPos(place.to, "x", true);
        if (!isFinite(from) || !isFinite(to)) continue;
        const width = Math.max(to - from, 2 * devicePixelRatio);
        ctx.fillRect(from, u.bbox.top, width, u.bbox.height);
        ctx.strokeRect(from, u.bbox.top - 5, width, u.bbox.height + 10);
      }
      ctx.restore();
    };
  }

  const parts = {
    time(signal) {
      const data = [signal.t], series = [{ label: "time", value: (u, v) => (v === null ? "–" : number(v) + " s") }];
      const add = (key, label, extra) => {
        if (!signal.values[key]) return;
        data.push(decode(signal.values[key]));
        series.push(line(label, key, extra));
      };
      add("reference", "reference", { dash: [2, 3], show: false });
      add("recorded", "recorded", { width: 1.6 });
      add("before", signal.values.after ? "simulated before" : "simulated", { dash: [7, 3] });
      add("after", "simulated after", {});
      return { data, series, group: "time", places: signal.places.filter((p) => p.kind === "time") };
    },
    residual(signal) {
      const data = [signal.t], series = [{ label: "time", value: (u, v) => (v === null ? "–" : number(v) + " s") }];
      const add = (key, label, extra) => {
        if (!signal.residuals[key]) return;
        data.push(decode(signal.residuals[key]));
        series.push(line(label, key, extra));
      };
      add("before", signal.residuals.after ? "before" : "residual", {});
      add("after", signal.residuals.fitted ? "after, held out" : "after", {});
      add("fitted", "after, fitted", { show: false });
      return { data, series, group: "time", places: signal.places.filter((p) => p.kind === "time"), zero: true };
    },
    against(signal, index) {
      const one = signal.against[index];
      const x = decode(one.x), before = decode(one.before), after = one.after ? decode(one.after) : before;
      const bins = one.bins, rows = [];
      // Values of a flag would hide each other: before stands left of the value, after right of it.
      let gap = 0;
      if (bins.discrete) {
        gap = Infinity;
        for (let k = 1; k < bins.x.length; k++) gap = Math.min(gap, bins.x[k] - bins.x[k - 1]);
        if (!isFinite(gap)) gap = Math.max(1, Math.abs(bins.x[0]) / 1000);
      }
      const aside = 0.18 * gap;
      x.forEach((v, k) => {
        if (!gap) { rows.push([v, before[k], after[k], null, null, null, null, null, null]); return; }
        const scatter = 0.12 * gap * (((k * 0.618034) % 1) - 0.5);
        rows.push([v - aside + scatter, before[k], null, null, null, null, null, null, null]);
        rows.push([v + aside + scatter, null, after[k], null, null, null, null, null, null]);
      });
      bins.x.forEach((v, k) => {
        const b = bins.before[k], a = bins.after[k];
        if (!gap) { rows.push([v, null, null, b[0], b[1], b[2], a[0], a[1], a[2]]); return; }
        rows.push([v - aside, null, null, b[0], b[1], b[2], null, null, null]);
        rows.push([v + aside, null, null, null, null, null, a[0], a[1], a[2]]);
      });
      rows.sort((a, b) => a[0] - b[0]);
      const data = Array.from({ length: 9 }, (_, k) => rows.map((row) => row[k]));
      const hidden = gap ? { paths: () => null } : {};
      const edge = (name) => line(name + ", 5 or 95 %", name, Object.assign({ width: 0, spanGaps: true, class: "quiet", twinGroup: name }, hidden));
      const middle = (label, name) => line(label, name, Object.assign({ width: 2.5, spanGaps: true, twinGroup: name }, hidden));
      return {
        data, scatter: true, places: one.places, zero: true, margin: gap * 0.45,
        discrete: gap ? { aside, bins, width: gap * 0.1 } : null,
        series: [
          { label: one.variable, value: (u, v) => number(v) },
          dots(one.after ? "before" : "residual", "before"), dots("after", "after"),
          edge("before"), middle(one.after ? "before" : "residual", "before"), edge("before"),
          edge("after"), middle("after", "after"), edge("after"),
        ].map((series) => (series.twinColour === "after" && !one.after ? Object.assign(series, { show: false, class: "quiet", twinGroup: null }) : series)),
        bands: gap ? [] : [
          { series: [5, 3], fill: () => clear("before", 0.16) },
          { series: [8, 6], fill: () => clear("after", 0.16) },
        ],
      };
    },
    spectrum(signal) {
      const s = signal.spectrum;
      return {
        data: s.after ? [s.f, s.before, s.after] : [s.f, s.before], log: true, places: signal.places.filter((p) => p.kind === "frequency"),
        series: [
          { label: "frequency", value: (u, v) => (v === null ? "–" : number(v) + " Hz") },
          line(s.after ? "before" : "residual", "before", { spanGaps: true }),
        ].concat(s.after ? [line("after", "after", { spanGaps: true })] : []),
      };
    },
  };

  // A zoom by `factor` about a place, in pixels so that it holds for logarithmic axes too.
  function zoom(u, factor, centre) {
    const width = u.over.clientWidth;
    const c = centre === undefined ? width / 2 : centre;
    move(u, c - c * factor, c + (width - c) * factor);
  }
  function move(u, left, right) {
    const width = u.over.clientWidth;
    if (left <= 0 && right >= width && u.twin.zoomed === false) return;
    let min = u.posToVal(left, "x"), max = u.posToVal(right, "x");
    const whole = u.twin.whole;
    // Never further out than everything.
    if (min <= whole[0] && max >= whole[1]) { reset(u); return; }
    min = Math.max(min, whole[0]);
    max = Math.min(max, whole[1]);
    // Nor further in than a fraction of a sample.
    if (!(max - min > (0.2 / u.data[0].length) * (whole[1] - whole[0]))) return;
    u.setScale("x", { min, max });
  }
  function pan(u, share) {
    const width = u.over.clientWidth;
    const [min, max] = u.twin.whole;
    const left = share * width, right = left + width;
    if (u.posToVal(left, "x") < min || u.posToVal(right, "x") > max) {
      // As far as there is something.
      const at = share < 0 ? u.valToPos(min, "x") : u.valToPos(max, "x") - width;
      if (Math.abs(at) > 0.5) u.setScale("x", { min: u.posToVal(at, "x"), max: u.posToVal(at + width, "x") });
      return;
    }
    u.setScale("x", { min: u.posToVal(left, "x"), max: u.posToVal(right, "x") });
  }
  function reset(u) {
    u.setScale("x", { min: u.twin.whole[0], max: u.twin.whole[1] });
    if (!u.twin.scatter) return;
    // Here dragging sets the height too, and it has to be given back.
    let low = Infinity, high = -Infinity;
    u.data.forEach((values, k) => {
      if (k === 0 || !u.series[k].show) return;
      for (const v of values) if (v !== null) { low = Math.min(low, v); high = Math.max(high, v); }
    });
    if (low <= high) {
      const [min, max] = uPlot.rangeNum(low, high, 0.1, true);
      u.setScale("y", { min, max });
    }
  }

  let following = false;
  function follow(u, key) {
    if (key !== "x" || !u.twin || following) return;
    const { min, max } = u.scales.x;
    u.twin.zoomed = !(min <= u.twin.whole[0] && max >= u.twin.whole[1]);
    if (!u.twin.group) return;
    following = true;
    for (const other of plots) {
      if (other !== u && other.twin.group === u.twin.group) {
        other.setScale("x", { min, max });
        other.twin.zoomed = u.twin.zoomed;
      }
    }
    following = false;
  }

  function hands(u, area) {
    const over = u.over;
    over.addEventListener("mousedown", () => area.focus({ preventScroll: true }));
    over.addEventListener("wheel", (event) => {
      // The page scrolls on under a wheel that only passes by.
      if (document.activeElement !== area && !event.ctrlKey) return;
      event.preventDefault();
      const box = over.getBoundingClientRect();
      if (Math.abs(event.deltaX) > Math.abs(event.deltaY)) pan(u, event.deltaX / box.width);
      else zoom(u, Math.pow(1.0015, Math.max(-400, Math.min(400, event.deltaY))), event.clientX - box.left);
    }, { passive: false });
    area.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.altKey || event.metaKey) return;
      const step = { "+": () => zoom(u, 0.6), "=": () => zoom(u, 0.6), "-": () => zoom(u, 1 / 0.6), "−": () => zoom(u, 1 / 0.6),
        ArrowLeft: () => pan(u, -0.2), ArrowRight: () => pan(u, 0.2), "0": () => reset(u), Home: () => reset(u), Escape: () => reset(u) }[event.key];
      if (!step) return;
      event.preventDefault();
      step();
    });
    // Two fingers zoom; one moves a plot that is zoomed in, sideways.
    const fingers = new Map();
    let held = null;
    const places = () => {
      const left = over.getBoundingClientRect().left;
      return [...fingers.values()].map((x) => x - left).sort((a, b) => a - b);
    };
    const hold = () => { held = fingers.size ? places().map((x) => [x, u.posToVal(x, "x")]) : null; };
    over.addEventListener("pointerdown", (event) => {
      if (event.pointerType !== "touch") return;
      fingers.set(event.pointerId, event.clientX);
      hold();
    });
    over.addEventListener("pointermove", (event) => {
      if (!fingers.has(event.pointerId)) return;
      const last = fingers.get(event.pointerId);
      fingers.set(event.pointerId, event.clientX);
      const width = over.clientWidth;
      if (fingers.size === 1 && u.twin.zoomed) pan(u, (last - event.clientX) / width);
      if (fingers.size === 2 && held && held.length === 2) {
        const now = places(), then = held.map(([, value]) => u.valToPos(value, "x"));
        const factor = (then[1] - then[0]) / Math.max(now[1] - now[0], 20);
        if (isFinite(factor) && factor > 0) move(u, then[0] - now[0] * factor, then[0] + (width - now[0]) * factor);
      }
    });
    for (const end of ["pointerup", "pointercancel", "pointerleave"]) {
      over.addEventListener(end, (event) => { if (fingers.delete(event.pointerId)) hold(); });
    }
  }

  function tools(u, figure, title) {
    const bar = document.createElement("div");
    bar.className = "tools";
    for (const [text, says, act] of [["−", "Zoom out", () => zoom(u, 1 / 0.6)], ["+", "Zoom in", () => zoom(u, 0.6)], ["All", "Show all", () => reset(u)]]) {
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = text;
      button.title = says;
      button.setAttribute("aria-label", says + ": " + title);
      button.addEventListener("click", act);
      bar.append(button);
    }
    figure.querySelector(".head").append(bar);
  }

  const wide = { time: 300, residual: 260, against: 250, spectrum: 250 };

  function draw(figure) {
    const kind = figure.dataset.plot, area = figure.querySelector(".area");
    const signal = signals[+figure.dataset.signal];
    const part = parts[kind](signal, +figure.dataset.index);
    const xs = part.data[0];
    let low = Infinity, high = -Infinity;
    for (const v of xs) if (v !== null) { low = Math.min(low, v); high = Math.max(high, v); }
    if (!(high > low)) { low -= 0.5; high += 0.5; }
    const margin = part.margin || (part.scatter ? 0.02 * (high - low) : 0);
    const whole = [low - margin, high + margin];
    const log = !!part.log;
    const options = {
      width: Math.max(200, area.clientWidth), height: wide[kind],
      series: part.series, bands: part.bands,
      scales: {
        x: { time: false, distr: log ? 3 : 1, auto: false, min: whole[0], max: whole[1], range: (u, min, max) => [min === null ? whole[0] : min, max === null ? whole[1] : max] },
        y: log ? { distr: 3 } : {},
      },
      axes: [axis(log ? logTicks : ticks, log), yAxis(log ? logTicks : ticks, log, part.group ? 58 : 40)],
      cursor: { drag: { x: true, y: !!part.scatter, uni: 20 }, sync: part.group ? { key: part.group + figure.dataset.signal, setSeries: false } : undefined,
        points: { size: 7 }, focus: { prox: -1 } },
      legend: { live: true, markers: { width: 0, fill: (u, k) => (u.series[k].twinColour ? colour(u.series[k].twinColour) : "transparent") } },
      hooks: {
        drawClear: [shade(part.places)],
        drawAxes: part.zero ? [zeroLine] : [],
        draw: part.discrete ? [boxes(part.discrete)] : [],
        setScale: [follow],
        setSeries: [together],
      },
    };
    options.axes[0].size = 34;
    // Long numbers need room.
    options.axes[0].space = 40 + 5 * Math.max(number(whole[0]).length, number(Math.round(whole[1])).length);
    if (part.discrete) options.axes[0].splits = () => part.discrete.bins.x;
    const u = new uPlot(options, part.data, area);
    u.twin = { group: part.group ? part.group + figure.dataset.signal : null, whole, zoomed: false, scatter: !!part.scatter };
    u.setScale("x", { min: whole[0], max: whole[1] });
    // uPlot's own double click shows the data's range; this one the range that was drawn first.
    u.over.addEventListener("dblclick", () => reset(u));
    area.twinPlot = u;
    plots.push(u);
    hands(u, area);
    tools(u, figure, figure.querySelector("h4").textContent);
  }

  // Median and 5 … 95 % at each value of a flag.
  function boxes(discrete) {
    return (u) => {
      const ctx = u.ctx;
      ctx.save();
      ctx.beginPath();
      ctx.rect(u.bbox.left, u.bbox.top, u.bbox.width, u.bbox.height);
      ctx.clip();
      for (const [name, side, index] of [["before", -1, 4], ["after", 1, 7]]) {
        if (!u.series[index].show) continue;
        discrete.bins.x.forEach((value, k) => {
          const [low, middle, high] = discrete.bins[name][k];
          if (middle === null) return;
          const centre = value + side * discrete.aside;
          const left = u.valToPos(centre - discrete.width, "x", true), right = u.valToPos(centre + discrete.width, "x", true);
          const y = (v) => u.valToPos(v, "y", true);
          ctx.fillStyle = clear(name, 0.3);
          ctx.fillRect(left, y(high), right - left, Math.max(y(low) - y(high), devicePixelRatio));
          ctx.fillStyle = colour(name);
          ctx.fillRect(left, y(middle) - 1.5 * devicePixelRatio, right - left, 3 * devicePixelRatio);
        });
      }
      ctx.restore();
    };
  }

  function zeroLine(u) {
    const { min, max } = u.scales.y;
    if (!(min < 0 && max > 0)) return;
    const y = Math.round(u.valToPos(0, "y", true)) + 0.5;
    u.ctx.save();
    u.ctx.strokeStyle = colour("soft");
    u.ctx.setLineDash([]);
    u.ctx.lineWidth = devicePixelRatio;
    u.ctx.beginPath();
    u.ctx.moveTo(u.bbox.left, y);
    u.ctx.lineTo(u.bbox.left + u.bbox.width, y);
    u.ctx.stroke();
    u.ctx.restore();
  }

  // Dots, band and median of one kind are shown and hidden together.
  let toggling = false;
  function together(u, index) {
    if (toggling || index === null || index === undefined) return;
    const group = u.series[index].twinGroup;
    if (!group) return;
    toggling = true;
    u.series.forEach((other, k) => {
      if (k !== index && other.twinGroup === group && other.show !== u.series[index].show) u.setSeries(k, { show: u.series[index].show });
    });
    toggling = false;
  }

  for (const signal of signals) signal.t = decode(signal.t);
  for (const figure of document.querySelectorAll("figure.plot")) draw(figure);

  function fit(width) {
    for (const u of plots) {
      const wanted = width || Math.max(200, u.root.parentElement.clientWidth);
      if (wanted !== u.width) u.setSize({ width: wanted, height: u.height });
    }
  }
  const recolour = () => plots.forEach((u) => u.redraw(false, true));
  let waiting = 0;
  addEventListener("resize", () => { cancelAnimationFrame(waiting); waiting = requestAnimationFrame(() => fit()); });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", recolour);
  // Paper is white and 18 cm wide.
  addEventListener("beforeprint", () => {
    root.dataset.print = "";
    for (const u of plots) u.setSize({ width: 640, height: u.height });
    recolour();
  });
  addEventListener("afterprint", () => { delete root.dataset.print; fit(); recolour(); });
  root.dataset.plots = String(plots.length);
})();
