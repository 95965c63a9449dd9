// Put into the page by tests/report_page.rs: uses it like a reader, and writes what it found into the title.
addEventListener("load", async () => {
  const found = { errors: window.probeErrors, resources: [], figures: [], steps: {} };
  const settle = () => new Promise((done) => setTimeout(done, 60));
  try {
    await settle();
    const parse = (hex) => [1, 3, 5].map((k) => parseInt(hex.slice(k, k + 2), 16));
    for (const figure of document.querySelectorAll("figure.plot")) {
      const area = figure.querySelector(".area"), u = area.twinPlot;
      const one = { kind: figure.dataset.plot, series: [], caption: !!figure.querySelector("figcaption").textContent.trim(),
        label: area.getAttribute("aria-label"), described: !!document.getElementById(area.getAttribute("aria-describedby")) };
      found.figures.push(one);
      if (!u) continue;
      const box = u.bbox;
      const pixels = u.ctx.getImageData(box.left, box.top, box.width, box.height).data;
      u.series.forEach((series, k) => {
        if (!series.twinColour || !series.show || series.class === "quiet") return;
        const [r, g, b] = parse(getComputedStyle(document.documentElement).getPropertyValue("--" + series.twinColour).trim());
        let count = 0;
        for (let p = 0; p < pixels.length; p += 4) {
          if (pixels[p + 3] > 60 && Math.abs(pixels[p] - r) < 20 && Math.abs(pixels[p + 1] - g) < 20 && Math.abs(pixels[p + 2] - b) < 20) count++;
        }
        one.series.push([series.label, count]);
      });
    }
    const areas = [...document.querySelectorAll(".area")].filter((area) => area.twinPlot);
    if (areas.length > 1) {
      const [area, below] = areas, u = area.twinPlot, over = u.over;
      const width = () => u.scales.x.max - u.scales.x.min;
      const whole = width();
      const share = async (name) => { await settle(); found.steps[name] = width() / whole; };
      const box = over.getBoundingClientRect();
      const at = (part) => ({ clientX: box.left + part * box.width, clientY: box.top + box.height / 2, bubbles: true, cancelable: true, view: window });
      const key = (name) => area.dispatchEvent(new KeyboardEvent("keydown", { key: name, bubbles: true, cancelable: true }));
      const wheel = (init) => over.dispatchEvent(new WheelEvent("wheel", Object.assign(at(0.25), { deltaY: -200 }, init)));
      document.activeElement.blur();
      wheel({});
      await share("wheel that passes by");
      wheel({ ctrlKey: true });
      await share("wheel with Ctrl");
      const before = u.scales.x.min;
      key("ArrowRight");
      await share("arrow");
      found.steps["arrow moved"] = (u.scales.x.min - before) / whole;
      key("0");
      await share("0");
      key("+");
      await share("+");
      found.steps["plot below"] = (below.twinPlot.scales.x.max - below.twinPlot.scales.x.min) / whole;
      over.dispatchEvent(new MouseEvent("dblclick", at(0.5)));
      await share("double click");
      over.dispatchEvent(new MouseEvent("mouseenter", at(0.2)));
      over.dispatchEvent(new MouseEvent("mousemove", Object.assign(at(0.2), { movementX: 9 })));
      over.dispatchEvent(new MouseEvent("mousedown", at(0.2)));
      over.dispatchEvent(new MouseEvent("mousemove", Object.assign(at(0.7), { movementX: 9 })));
      over.dispatchEvent(new MouseEvent("mouseup", at(0.7)));
      await share("drag over half");
      area.parentElement.querySelector(".tools button:last-child").click();
      await share("button All");
      wheel({});
      await share("wheel after a click");
      key("Home");
      await settle();
      const finger = (kind, id, part) => over.dispatchEvent(new PointerEvent(kind, Object.assign(at(part), { pointerId: id, pointerType: "touch" })));
      finger("pointerdown", 1, 0.4);
      finger("pointerdown", 2, 0.6);
      finger("pointermove", 1, 0.3);
      finger("pointermove", 2, 0.7);
      finger("pointerup", 1, 0.3);
      finger("pointerup", 2, 0.7);
      await share("two fingers, twice apart");
      for (let k = 0; k < 40; k++) { key("-"); await Promise.resolve(); }
      await share("out beyond everything");
      for (let k = 0; k < 100; k++) { key("+"); await Promise.resolve(); }
      await share("in beyond every sample");
      key("0");
      await settle();
      const entry = below.querySelectorAll(".u-series")[1], range = below.twinPlot.scales.y.max - below.twinPlot.scales.y.min;
      entry.querySelector("th").click();
      await settle();
      found.steps["hidden before"] = (below.twinPlot.scales.y.max - below.twinPlot.scales.y.min) / range;
      entry.querySelector("th").click();
      await settle();
      const scatter = areas.find((area) => area.parentElement.dataset.plot === "against");
      if (scatter) {
        const v = scatter.twinPlot, height = () => v.scales.y.max - v.scales.y.min, all = height();
        const inside = v.over.getBoundingClientRect();
        const point = (x, y) => ({ clientX: inside.left + x * inside.width, clientY: inside.top + y * inside.height, movementX: 9, movementY: 9, bubbles: true, cancelable: true, view: window });
        for (const [kind, x, y] of [["mouseenter", 0.2, 0.25], ["mousemove", 0.2, 0.25], ["mousedown", 0.2, 0.25], ["mousemove", 0.7, 0.75], ["mouseup", 0.7, 0.75]]) {
          v.over.dispatchEvent(new MouseEvent(kind, point(x, y)));
        }
        await settle();
        found.steps["scatter dragged"] = height() / all;
        scatter.dispatchEvent(new KeyboardEvent("keydown", { key: "0", bubbles: true, cancelable: true }));
        await settle();
        found.steps["scatter reset"] = height() / all;
      }
      dispatchEvent(new Event("beforeprint"));
      await settle();
      found.steps["width in print"] = u.width;
      found.steps["white in print"] = getComputedStyle(document.body).backgroundColor === "rgb(255, 255, 255)" ? 1 : 0;
      dispatchEvent(new Event("afterprint"));
      await settle();
      found.steps["width after print"] = u.width / area.clientWidth;
    }
    const ids = [...document.querySelectorAll("[id]")].map((node) => node.id);
    found.twice = ids.filter((id, k) => ids.indexOf(id) !== k);
    found.dangling = [...document.querySelectorAll("a[href^='#']")].map((a) => a.getAttribute("href").slice(1)).filter((id) => !ids.includes(id));
    found.unscoped = document.querySelectorAll("th:not([scope])").length - document.querySelectorAll(".u-legend th:not([scope])").length;
    found.levels = [...document.querySelectorAll("h1, h2, h3, h4")].map((h) => +h.tagName[1]);
    found.overflow = document.documentElement.scrollWidth - document.documentElement.clientWidth;
    found.dark = matchMedia("(prefers-color-scheme: dark)").matches;
    found.text = document.querySelector("main").innerText.slice(0, 400);
    found.resources = performance.getEntriesByType("resource").map((entry) => entry.name);
  } catch (error) {
    found.errors.push("the probe: " + error);
  }
  window.parent.postMessage(JSON.stringify(found), "*");
});
