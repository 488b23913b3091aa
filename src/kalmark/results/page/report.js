"use strict";
const OUTCOME = {associated: "#4a8f7b", new: "#d2a23c", rejected: "#c8553d", ignored: "#aab0ba",
                 deferred: "#7c86b8", tentative: "#b48ac0"};
const CONFIG = {responsive: true, displaylogo: false, modeBarButtonsToRemove: ["select2d", "lasso2d"]};
const el = id => document.getElementById(id);
const axis = title => ({title: {text: title, standoff: 8}, gridcolor: GRID, zeroline: false, linecolor: RIM,
                        automargin: true});
const END = Math.max(0, ...DATA.robots.flatMap(r => r.t.slice(-1))) || 1;
const timeAxis = () => ({...axis("time (s)"), range: [0, END]});
const layout = extra => ({margin: {l: 64, r: 16, t: 10, b: 44}, font: {family: "system-ui, sans-serif", size: 13, color: INK},
                          paper_bgcolor: PAPER, plot_bgcolor: PAPER, hovermode: "closest",
                          legend: {orientation: "h", y: -0.12, x: 0}, ...extra});

/* A logarithmic axis around values, with ticks that are plain numbers; at most the upper six decades. */
function logAxis(title, values) {
  const logs = values.filter(v => v > 0).map(Math.log10);
  const top = logs.reduce((a, v) => Math.max(a, v), 0.4);
  const bottom = Math.max(logs.reduce((a, v) => Math.min(a, v), -0.4), top - 6), pad = 0.04 * (top - bottom);
  const steps = top - bottom > 2.5 ? [1] : [1, 2, 5], tickvals = [];
  for (let k = Math.floor(bottom); k <= top; k++) for (const m of steps) tickvals.push(Number(m + "e" + k));
  return {...axis(title), type: "log", range: [bottom - pad, top + pad], tickvals, ticktext: tickvals.map(v => `${v}`)};
}

/* The number of steps of a robot up to a time. */
function upTo(t, now) {
  let low = 0, high = t.length;
  while (low < high) {
    const mid = (low + high) >> 1;
    if (t[mid] <= now + 1e-6) low = mid + 1; else high = mid;
  }
  return low;
}

/* Values, broken before each that follows a gap in time. */
function broken(values, gaps) {
  const at = new Set(gaps);
  return values.flatMap((v, i) => at.has(i) ? [null, v] : [v]);
}

/* The first n steps of a robot's path, broken where its way is unknown; and the rest of it. */
function pathOf(r, n, axes) {
  return Object.fromEntries(axes.map(k => [k, broken(r[k].slice(0, n), r.dotted)]));
}
function bridgesOf(r, n, axes) {
  const dotted = r.dotted.filter(g => g < n), goesOn = new Set(dotted.map(g => g + 1));
  const way = k => dotted.flatMap(g => goesOn.has(g) ? [r[k][g]] : [null, r[k][g - 1], r[k][g]]);
  return Object.fromEntries(axes.map(k => [k, way(k)]));
}

/* A curve over time, broken at gaps; what is alone between two of them is a dot. */
function curve(t, values, gaps, style) {
  const x = broken(t, gaps), y = broken(values, gaps), none = v => v === null || v === undefined;
  const alone = y.map((v, i) => !none(v) && none(y[i - 1]) && none(y[i + 1]));
  return {x, y, mode: alone.includes(true) ? "lines+markers" : "lines", marker: {size: alone.map(a => a ? 3 : 0)}, ...style};
}

/* The band between two curves over time, an outline for each stretch between gaps. */
function band(t, low, high, gaps) {
  const x = [], y = [], at = new Set(gaps);
  let stretch = [];
  const close = () => {
    const back = [...stretch].reverse();
    x.push(...stretch.map(i => t[i]), ...back.map(i => t[i]), null);
    y.push(...stretch.map(i => low[i]), ...back.map(i => high[i]), null);
    stretch = [];
  };
  t.forEach((_, i) => {
    if (at.has(i) || low[i] === null) close();
    if (low[i] !== null) stretch.push(i);
  });
  close();
  return {x, y, mode: "lines", line: {width: 0}, fill: "toself", fillcolor: BAND, hoverinfo: "skip"};
}

/* Draw what an element holds when it comes into view, or is printed: to draw all at once takes longer than the map. */
const waiting = new Map();
const drawNow = element => { waiting.get(element)?.(); waiting.delete(element); coming.unobserve(element); };
const coming = new IntersectionObserver(seen => seen.filter(s => s.isIntersecting).forEach(s => drawNow(s.target)), {rootMargin: "200px"});
function inView(id, draw) {
  waiting.set(el(id), draw);
  coming.observe(el(id));
}
window.addEventListener("beforeprint", () => [...waiting.keys()].forEach(drawNow));

function drawMap() {
  if (!DATA.maps.length) { el("map").textContent = "No scan was processed."; return; }
  const slider = el("time"), draw = mapPicture(), mapped = DATA.maps.some(map => map.count);
  const steps = [...new Set(DATA.robots.flatMap(r => r.t))].sort((a, b) => a - b), pace = Math.ceil(steps.length / 120);
  let timer = null;
  const show = () => {  /* the robots at a step, and the map that was kept last until then */
    const now = steps[+slider.value], kept = Math.max(0, upTo(DATA.maps.map(map => map.t - 5e-4), now) - 1);
    el("now").textContent = `step ${+slider.value + 1} of ${steps.length} · ${now.toFixed(2)} s` + (mapped ? ` · ${DATA.maps[kept].count} landmarks` : "");
    draw(kept, now, timer !== null);
  };
  const move = by => { slider.value = +slider.value + by; show(); };
  slider.max = steps.length - 1;
  slider.value = slider.max;
  slider.addEventListener("input", show);
  el("back").addEventListener("click", () => move(-1));
  el("next").addEventListener("click", () => move(1));
  document.addEventListener("keydown", event => {
    const by = {ArrowLeft: -1, ArrowRight: 1}[event.key];
    if (!by || event.ctrlKey || event.altKey || event.metaKey || event.target.tagName === "SELECT") return;
    event.preventDefault();
    move(by);
  });
  el("play").addEventListener("click", () => {
    if (timer !== null) { clearInterval(timer); timer = null; el("play").textContent = "Play"; return; }
    if (+slider.value >= +slider.max) slider.value = 0;
    el("play").textContent = "Pause";
    timer = setInterval(() => {
      if (+slider.value >= +slider.max) { el("play").click(); return; }
      move(pace);
    }, 120);
  });
  show();
}

function drawErrors(robot) {
  const names = DATA.dof === 3 ? ["x (m)", "y (m)", "heading (deg)"]
    : ["x (m)", "y (m)", "z (m)", "about x (deg)", "about y (deg)", "about z (deg)"];
  const traces = [], page = layout({height: 560, showlegend: false}), two = names.length > 3;
  names.forEach((name, i) => {
    const n = i + 1, row = i % 3, right = i > 2, at = {xaxis: right ? "x2" : "x", yaxis: "y" + (i ? n : "")};
    const [low, high] = [-3, 3].map(n => robot.sigma[i].map(s => s === null ? null : n * s));
    traces.push({...band(robot.t, low, high, robot.gaps), ...at});
    traces.push(curve(robot.t, robot.error[i], robot.gaps, {line: {color: robot.colour, width: 1.1},
                      hovertemplate: `%{x:.1f} s: %{y:.4g}<extra>${name}</extra>`, ...at}));
    page["yaxis" + (i ? n : "")] = {...axis(name), domain: [1 - (row + 1) / 3 + 0.025, 1 - row / 3 - 0.01], zeroline: true,
                                    zerolinecolor: RIM, anchor: right ? "x2" : "x"};
  });
  page.xaxis = {...timeAxis(), anchor: "y3", domain: [0, two ? 0.46 : 1]};
  if (two) page.xaxis2 = {...timeAxis(), anchor: "y6", domain: [0.54, 1], matches: "x"};
  Plotly.react("errors", traces, page, CONFIG);
  const [low, high] = DATA.neesBounds, ends = [robot.t[0], robot.t[robot.t.length - 1]];
  el("nees-note").textContent = `${DATA.dof} degrees of freedom; the band holds 95 % of a consistent filter's values; errors last, so a run may be outside for long`;
  Plotly.react("nees", [band(ends, [low, low], [high, high], []),
    curve(robot.t, robot.nees, robot.gaps, {line: {color: robot.colour, width: 1.1},
          hovertemplate: "%{x:.1f} s: %{y:.3g}<extra></extra>"}),
    {x: ends, y: [DATA.dof, DATA.dof], mode: "lines", line: {color: INK, width: 1, dash: "dot"}, hoverinfo: "skip"}],
    layout({height: 280, showlegend: false, xaxis: timeAxis(), yaxis: logAxis("NEES", [...robot.nees, low, high])}), CONFIG);
}

function drawSigmas(robot) {
  const metres = robot.sigma.length > 3 ? 3 : 2, names = metres > 2 ? ["x", "y", "z", "about x", "about y", "about z"] : ["x", "y", "heading"];
  const traces = robot.sigma.map((sigma, i) => ({...curve(robot.t, sigma, robot.gaps, {name: names[i],
    hovertemplate: `%{x:.1f} s: %{y:.3g}<extra>${names[i]}</extra>`}), ...(i < metres ? {} : {yaxis: "y2"})}));
  Plotly.react("sigmas", traces, layout({height: 380, showlegend: true, xaxis: {...timeAxis(), anchor: "y2"},
    yaxis: {...axis("position (m)"), domain: [0.53, 1]}, yaxis2: {...axis("heading (deg)"), domain: [0, 0.47]},
    legend: {orientation: "h", y: 1.02, yanchor: "bottom"}}), CONFIG);
}

function drawNis() {
  const nis = DATA.nis;
  const meaning = "the band would hold 95 % of them if observations were independent; those of a scan share the error of the pose, so more are outside";
  el("nis-note").textContent = `${nis.window > 1 ? `mean over windows of ${nis.window} scans` : "each scan"}; ${meaning}`;
  Plotly.react("nis", [band(nis.t, nis.low, nis.high, nis.gaps),
    curve(nis.t, nis.value, nis.gaps, {line: {color: BLUE, width: 1.1},
          hovertemplate: "%{x:.1f} s: %{y:.3g}<extra></extra>"}),
    {x: [nis.t[0], nis.t[nis.t.length - 1]], y: [1, 1], mode: "lines", line: {color: INK, width: 1, dash: "dot"}, hoverinfo: "skip"}],
    layout({height: 280, showlegend: false, xaxis: timeAxis(), yaxis: logAxis("NIS / dof", [...nis.value, ...nis.low, ...nis.high])}), CONFIG);
}

/* How far the fixes of a robot were from the estimate. */
function drawFixes(robot) {
  const traces = [], count = robot.z.length, page = layout({height: 80 + 140 * count, showlegend: false});
  robot.z.forEach((z, i) => {
    const at = {yaxis: "y" + (i ? i + 1 : "")}, [low, high] = [-3, 3].map(n => robot.sigma[i].map(s => n * s));
    const hovertemplate = `%{x:.1f} s: %{y:.4g} m<extra>${"xyz"[i]}</extra>`;
    traces.push({...band(robot.t, low, high, robot.gaps), ...at},
      curve(robot.t, z, robot.gaps, {line: {color: robot.colour, width: 1.1}, hovertemplate, ...at}),
      {x: robot.rejected.t, y: robot.rejected.z[i], mode: "markers", hovertemplate, ...at,
       marker: {symbol: "x-thin", size: 7, line: {color: OUTCOME.rejected, width: 1.5}}});
    page["yaxis" + (i ? i + 1 : "")] = {...axis("xyz"[i] + " (m)"), domain: [1 - (i + 1) / count + 0.025, 1 - i / count - 0.01],
                                        zeroline: true, zerolinecolor: RIM};
  });
  const range = [Math.min(0, robot.t[0]), Math.max(END, robot.t[robot.t.length - 1])];
  page.xaxis = {...axis("time (s)"), range, anchor: "y" + (count > 1 ? count : "")};
  Plotly.react("fixes", traces, page, CONFIG);
}

/* Draw what is of one robot, with a choice if there are several; without any, remove the section. */
function ofEach(robots, choice, section, draw) {
  if (!robots.length) { el(section).remove(); return; }
  robots.forEach((r, i) => el(choice).add(new Option(r.name, i)));
  el(choice).hidden = robots.length < 2;
  el(choice).addEventListener("change", () => draw(robots[+el(choice).value]));
  inView(section, () => draw(robots[+el(choice).value]));
}

const CHANGE = {merged: [BLUE, "triangle-down"], removed: ["#c8553d", "x-thin"]};

/* One ambiguous scan: observations, the landmarks each was compared with, and the decision. */
function drawScan(scan) {
  const traces = [], ring = contours(scan.pose, [0], 24, "xy");
  traces.push({...ring, mode: "lines", line: {color: BLUE, width: 1}, name: `robot, ${SIGMAS}`, hoverinfo: "skip"},
    {x: scan.pose.x, y: scan.pose.y, mode: "markers", marker: {color: BLUE, size: 9}, showlegend: false,
     hovertemplate: `${scan.robot}<extra></extra>`});
  const named = new Set();
  for (const seen of scan.seen.filter(s => s.x !== null)) {
    const colour = OUTCOME[seen.outcome], first = !named.has(seen.outcome);
    named.add(seen.outcome);
    for (const near of seen.near) {
      const chosen = near.name === seen.landmark;
      traces.push({x: [seen.x, near.x], y: [seen.y, near.y], mode: "lines", hoverinfo: "skip", showlegend: false,
                   line: {color: colour, width: chosen ? 2.5 : 1, dash: chosen ? "solid" : "dot"}});
    }
    traces.push({x: seen.near.map(n => n.x), y: seen.near.map(n => n.y), mode: "markers+text", showlegend: false,
      text: seen.near.map(n => n.name), textposition: "bottom right", textfont: {size: 11, color: INK},
      marker: {symbol: "square-open", size: 10, color: INK}, hovertemplate: `observation ${seen.k}, %{text}<extra></extra>`});
    const others = seen.near.filter(n => n.name !== seen.landmark), chosen = seen.near.find(n => n.name === seen.landmark);
    const along = axis => others.map(n => seen[axis] + 0.35 * (n[axis] - seen[axis]));
    traces.push({x: along("x"), y: along("y"), mode: "text", text: others.map(n => `${n.d2}`), showlegend: false,
      textfont: {size: 11, color: colour}, hoverinfo: "skip"});
    const above = others.reduce((sum, n) => sum + n.y - seen.y, 0) > 0;  /* where the lines go */
    traces.push({x: [seen.x], y: [seen.y], mode: "markers+text", text: [chosen ? `${seen.k}: ${chosen.d2}` : seen.k],
      textposition: above ? "bottom center" : "top center",
      textfont: {size: 12, color: colour}, marker: {symbol: "x-thin", size: 11, line: {color: colour, width: 3}},
      name: seen.outcome, legendgroup: seen.outcome, showlegend: first, hovertemplate: `${seen.k}: ${escaped(seen.text)}<extra></extra>`});
  }
  Plotly.react("scan", traces, layout({height: 520, showlegend: true, xaxis: {...axis("x (m)"), constrain: "domain"},
    yaxis: {...axis("y (m)"), scaleanchor: "x"}}), CONFIG);
  el("told").replaceChildren(...scan.seen.map(seen => {
    const line = document.createElement("li");
    line.textContent = `${seen.k}: ${seen.text}`;
    line.style.borderColor = OUTCOME[seen.outcome];
    return line;
  }));
}

function escaped(text) {
  return text.replace(/&/g, "&amp;").replace(/</g, "&lt;");
}

function drawOutcomes() {
  const top = Math.max(...DATA.outcomes.t.map((_, i) =>
    Object.values(DATA.outcomes.counts).reduce((sum, column) => sum + column[i], 0)));
  const marks = Object.entries(DATA.association.changes).map(([what, t], i) =>
    ({x: t, y: t.map(() => top * (1.05 + 0.07 * i)), mode: "markers", name: `landmark ${what}`,
      marker: {color: CHANGE[what][0], symbol: CHANGE[what][1], size: 6, line: {color: CHANGE[what][0], width: 1}},
      hovertemplate: `%{x:.1f} s: landmark ${what}<extra></extra>`}));
  const traces = Object.entries(DATA.outcomes.counts).map(([name, y]) =>
    ({x: DATA.outcomes.t, y, type: "bar", name, marker: {color: OUTCOME[name]},
      hovertemplate: `%{x:.1f} s: %{y} ${name}<extra></extra>`}));
  Plotly.react("outcomes", [...traces, ...marks], layout({height: 280, barmode: "stack", bargap: 0, xaxis: timeAxis(), showlegend: true,
    yaxis: axis("observations"), legend: {orientation: "h", y: 1.02, yanchor: "bottom"}}), CONFIG);
}

drawMap();
ofEach(DATA.robots.filter(r => r.error), "robot", "against-truth", drawErrors);
ofEach(DATA.robots.filter(r => !r.error), "blind", "sigma-section", drawSigmas);
ofEach(DATA.innovations, "fixed", "fixes-section", drawFixes);
if (DATA.nis.t.length) inView("nis-section", drawNis); else el("nis-section").remove();
if (Object.keys(DATA.outcomes.counts).length) inView("association", drawOutcomes); else el("association").remove();
if (DATA.association.scans.length && el("which")) {
  DATA.association.scans.forEach((scan, i) => el("which").add(new Option(`t = ${scan.t} s, ${scan.robot} (--scan ${scan.in_log})`, i)));
  el("which").addEventListener("change", () => drawScan(DATA.association.scans[+el("which").value]));
  inView("ambiguous", () => drawScan(DATA.association.scans[0]));
} else if (el("ambiguous")) el("ambiguous").remove();
