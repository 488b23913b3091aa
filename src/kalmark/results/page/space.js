"use strict";
/* The map of a run in space, which turns under the mouse, and the images of its cameras at the slider. */
const GROUPS = [["#1f5fa8", "landmarks, 3 sigma"], ["#c8412f", "landmarks that are not Euclidean, 3 sigma"],
                ["#8c1c13", "lines, 3 sigma of their ends"]];
const GROUND = "#cfd4dc", TAG = "#1f5fa8", POSE = "#d62f2f", MEASURED = "#7d838d", SEGMENT = "rgba(58,104,200,0.55)";

/* Nothing where a point lies outside the box: points at great depth would shrink all the rest to a dot. */
function boxed(p) {
  const {low, high} = DATA.space, keep = p.x.map((_, i) => ["x", "y", "z"].every((k, a) => p[k][i] >= low[a] && p[k][i] <= high[a]));
  const cut = k => p[k].map((v, i) => keep[i] ? v : null);
  return {x: cut("x"), y: cut("y"), z: cut("z")};
}

/* The 3-sigma ellipsoids of the Gaussians `rows` as three great circles each, one broken line: mean + 3 L c. */
function ellipsoids(g, rows, points = 20) {
  const out = {x: [], y: [], z: []};
  for (const i of rows) {
    if (g.pxx[i] === null || g.x[i] === null) continue;
    const a = Math.sqrt(Math.max(g.pxx[i], 0)), b = a ? g.pxy[i] / a : 0, c = a ? g.pxz[i] / a : 0;
    const d = Math.sqrt(Math.max(g.pyy[i] - b * b, 0)), e = d ? (g.pyz[i] - b * c) / d : 0;
    const f = Math.sqrt(Math.max(g.pzz[i] - c * c - e * e, 0));
    for (const [u, v] of [[0, 1], [1, 2], [0, 2]]) {
      for (let k = 0; k <= points; k++) {
        const w = [0, 0, 0];
        w[u] = 3 * Math.cos(2 * Math.PI * k / points);
        w[v] = 3 * Math.sin(2 * Math.PI * k / points);
        out.x.push(g.x[i] + a * w[0]);
        out.y.push(g.y[i] + b * w[0] + d * w[1]);
        out.z.push(g.z[i] + c * w[0] + e * w[1] + f * w[2]);
      }
      for (const k of ["x", "y", "z"]) out[k].push(null);
    }
  }
  return boxed(out);
}

/* A polyline of a robot's frame placed at its pose at step i. */
function placed(body, r, i) {
  const [x, y, z, w] = r.q.map(q => q[i]), out = {x: [], y: [], z: []};
  const Q = [[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
             [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
             [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]];
  body.x.forEach((_, k) => ["x", "y", "z"].forEach((axis, a) =>
    out[axis].push(body.x[k] === null ? null : r[axis][i] + Q[a][0] * body.x[k] + Q[a][1] * body.y[k] + Q[a][2] * body.z[k])));
  return out;
}

const stroke = (points, color, width, extra) =>
  ({...points, type: "scatter3d", mode: "lines", line: {color, width}, hoverinfo: "skip", connectgaps: false, ...extra});
const quiet = {showlegend: false};

function ground() {
  const {low, high} = DATA.space, size = Math.max(high[0] - low[0], high[1] - low[1]), z = low[2] <= 0 && high[2] >= 0 ? 0 : low[2];
  let step = 2;
  if (size < 8 || size > 40) {
    const power = 10 ** Math.floor(Math.log10(size / 10));
    step = power * [1, 2, 5, 10].find(m => size / (m * power) <= 14);
  }
  const grid = {x: [], y: [], z: []}, line = (a, b) => {
    grid.x.push(a[0], b[0], null); grid.y.push(a[1], b[1], null); grid.z.push(z, z, null);
  };
  for (let x = Math.ceil(low[0] / step) * step; x <= high[0]; x += step) line([x, low[1]], [x, high[1]]);
  for (let y = Math.ceil(low[1] / step) * step; y <= high[1]; y += step) line([low[0], y], [high[0], y]);
  return stroke(grid, GROUND, 1, quiet);
}

function spatialStill() {
  const traces = [ground()];
  DATA.robots.filter(r => r.truth).forEach((r, i) =>
    traces.push(stroke(r.truth, "#9aa1ab", 4, {name: "true path", legendgroup: "truth", showlegend: i === 0})));
  if (DATA.trueLines.x.length) traces.push(stroke(DATA.trueLines, "#9aa1ab", 4, {name: "true lines"}));
  const l = DATA.trueLandmarks;
  if (l.x.length)
    traces.push({...boxed(l), text: l.id, type: "scatter3d", mode: "markers", name: "true landmarks",
                 marker: {symbol: "cross", size: 3, color: "#8b929c"},
                 hovertemplate: "true %{text}: %{x:.3f}, %{y:.3f}, %{z:.3f}<extra></extra>"});
  Object.values(DATA.usedFixes).forEach((f, i) =>
    traces.push({...f, type: "scatter3d", mode: "markers", marker: {color: "#7a3fa0", size: 2, symbol: "x"}, name: "fixes used",
                 legendgroup: "fixes", showlegend: i === 0, hoverinfo: "skip"}));
  return traces;
}

function spatialMoving(frame) {
  const map = DATA.maps[frame], traces = [], many = map.count > 100;
  GROUPS.forEach(([color, name], group) => {
    const rows = map.group.flatMap((g, i) => g === group ? [i] : []), pick = k => rows.map(i => map[k][i]);
    const points = boxed({x: pick("x"), y: pick("y"), z: pick("z")});
    const sigma = rows.map(i => map.pxx[i] === null ? null : Math.sqrt(map.pxx[i] + map.pyy[i] + map.pzz[i]));
    const shown = rows.length > 0 || DATA.maps.some(m => m.group.includes(group));
    traces.push(stroke(ellipsoids(map, rows, many ? 12 : 20), color, many ? 1 : 2, {name, legendgroup: name, showlegend: shown, opacity: 0.6}));
    traces.push({...points, text: pick("id"), customdata: sigma, type: "scatter3d", mode: "markers", legendgroup: name, ...quiet,
                 marker: {color, size: many ? 1.8 : 3},
                 hovertemplate: "%{text}: %{x:.3f}, %{y:.3f}, %{z:.3f}<br>sigma %{customdata:.3g} m<extra></extra>"});
  });
  traces.push(stroke(boxed(map.lines), GROUPS[2][0], 4, quiet), stroke(map.tags, TAG, 3, quiet));
  DATA.robots.forEach((r, i) => {
    const n = upTo(r.t, map.t), name = DATA.robots.length > 1 ? r.name : "estimated path", at = {legendgroup: r.name, ...quiet};
    traces.push(stroke(pathOf(r, n, ["x", "y", "z"]), r.colour, 4, {name, legendgroup: r.name}));
    traces.push(stroke(n ? placed(DATA.bodies[r.name], r, n - 1) : {x: [], y: [], z: []}, r.colour, 3, at));
    traces.push(stroke(ellipsoids(r, n ? [n - 1] : [], 32), POSE, 2,
                       {name: "robot, 3 sigma", legendgroup: "pose", showlegend: i === 0}));
  });
  return traces;
}

/* The picture of a map in space: a function that draws it, and the images, at a position of the slider. */
function spatialMap() {
  const {low, high} = DATA.space, background = spatialStill();
  const spans = high.map((v, a) => v - low[a]), unit = Math.max(...spans) / 1.05;
  const ratio = Object.fromEntries(["x", "y", "z"].map((axis, a) => [axis, spans[a] / unit]));
  const side = (title, a) => ({title: {text: title}, range: [low[a], high[a]], backgroundcolor: "white", gridcolor: "#e6e8ec",
                               zerolinecolor: "#e6e8ec", showspikes: false});
  const page = layout({height: 640, uirevision: "map", margin: {l: 0, r: 0, t: 0, b: 0}, legend: {orientation: "h", y: 0.02, x: 0.02},
    scene: {aspectmode: "manual", aspectratio: ratio, uirevision: "map",
            xaxis: side("x (m)", 0), yaxis: side("y (m)", 1), zaxis: side("z (m)", 2),
            camera: {center: {x: 0, y: 0, z: -0.18}, eye: {x: 0.95, y: -1.4, z: 0.9}, up: {x: 0, y: 0, z: 1}}, dragmode: "turntable"}});
  return frame => {
    const shown = el("map")._fullLayout?.scene?._scene;  /* the slider must not turn the view back */
    if (shown) page.scene.camera = shown.getCamera();
    Plotly.react("map", [...background, ...spatialMoving(frame)], page, CONFIG);
    DATA.cameras.forEach((camera, i) => drawImages(camera, i, frame));
  };
}

/* The part of the straight line through two pixels that lies in the image, or nothing. */
function trimmed([a, b], size) {
  const d = [b[0] - a[0], b[1] - a[1]];
  let first = -Infinity, last = Infinity;
  for (const k of [0, 1]) {
    if (d[k] === 0) { if (a[k] < 0 || a[k] > size[k]) return []; continue; }
    const ends = [-a[k] / d[k], (size[k] - a[k]) / d[k]].sort((p, q) => p - q);
    first = Math.max(first, ends[0]);
    last = Math.min(last, ends[1]);
  }
  return first < last ? [first, last].map(t => [a[0] + t * d[0], a[1] + t * d[1]]) : [];
}

function drawImages(camera, i, frame) {
  const scan = camera.frames[frame] === null ? null : camera.scans[camera.frames[frame]];
  const sides = camera.scans.length ? camera.scans[0].images.length : 0;
  for (let k = 0; k < sides; k++) {
    const id = `image-${i}-${k}`;
    if (!el(id)) el("images").insertAdjacentHTML("beforeend", `<div id="${id}"></div>`);
    drawImage(id, camera, scan, scan ? scan.images[k] : {side: "", seen: []});
  }
}

function drawImage(id, camera, scan, image) {
  const {size} = camera, lines = new Map(), marks = {new: [], rejected: [], measured: []}, names = {x: [], y: [], text: []};
  const add = (colour, name, dash, width, points) => {
    const key = colour + dash;
    if (!lines.has(key)) lines.set(key, {x: [], y: [], mode: "lines", line: {color: colour, width, dash}, name, hoverinfo: "skip"});
    for (const p of points) { lines.get(key).x.push(p[0]); lines.get(key).y.push(p[1]); }
    lines.get(key).x.push(null);
    lines.get(key).y.push(null);
  };
  for (const s of image.seen) {
    const single = s.y.length === 1, close = p => p.length > 2 ? [...p, p[0]] : p, dash = s.outcome === "rejected" ? "dot" : "solid";
    if (single) marks.measured.push([...s.y[0], s.name]); else add(SEGMENT, "measured", "solid", 4, close(s.y));
    if (s.outcome in marks) marks[s.outcome].push(...s.y.map(p => [...p, s.name]));
    if (s.e && single && s.Z) {
      const e = ellipses({x: [s.e[0][0]], y: [s.e[0][1]], pxx: [s.Z[0]], pxy: [s.Z[1]], pyy: [s.Z[2]]}, 0, 1, 32);
      add(s.colour, s.meaning, dash, 1.4, e.x.slice(0, -1).map((x, k) => [x, e.y[k]]));
    } else if (s.e) add(s.colour, s.meaning, dash, 1.4, s.e.length === 2 ? trimmed(s.e, size) : close(s.e));
    if (s.name && s.outcome !== "ignored") {
      const at = s.e && single ? s.e : s.y, mean = a => at.reduce((sum, p) => sum + p[a], 0) / at.length;
      names.x.push(mean(0)); names.y.push(mean(1) - 15); names.text.push(s.name);
    }
  }
  const dots = (points, name, marker) => ({x: points.map(p => p[0]), y: points.map(p => p[1]), text: points.map(p => p[2]), name,
    mode: "markers", marker, hovertemplate: `%{text} ${name}: %{x:.1f}, %{y:.1f}<extra></extra>`, showlegend: points.length > 0});
  const high = (el(id).clientWidth || 500) * size[1] / size[0];  /* below the image its ticks, then a legend of two rows at most */
  const title = `${camera.name}${image.side ? " · " + image.side : ""}${scan ? ` · ${scan.t.toFixed(2)} s` : ""}`;
  Plotly.react(id, [
    dots(marks.measured, "measured", {symbol: "cross-thin", size: 9, line: {color: MEASURED, width: 1.3}}), ...lines.values(),
    dots(marks.new, "new", {symbol: "square-open", size: 10, color: "#1e4d2b"}),
    dots(marks.rejected, "rejected", {symbol: "x-thin", size: 9, line: {color: INK, width: 1.6}}),
    {...names, mode: "text", textfont: {size: 10, color: "#1e4d2b"}, hoverinfo: "skip", showlegend: false}],
    layout({height: high + 100, title: {text: title, x: 0.01, font: {size: 13}}, margin: {l: 44, r: 10, t: 30, b: 70},
            xaxis: {...axis(""), range: [0, size[0]], constrain: "domain", mirror: true, showline: true},
            yaxis: {...axis(""), range: [size[1], 0], scaleanchor: "x", constrain: "domain", mirror: true, showline: true},
            showlegend: true, legend: {orientation: "h", y: -24 / high, yanchor: "top", x: 0, font: {size: 11}}}), {...CONFIG, displayModeBar: false});
}
