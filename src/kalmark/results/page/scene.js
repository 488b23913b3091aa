"use strict";
/* The map of a run, in the plane or in space, where it turns under the mouse, and the images of cameras at the slider. */
const AXES = DATA.dof === 3 ? ["x", "y"] : ["x", "y", "z"], SPACE = AXES.length === 3;
const style = name => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
const [INK, PAPER, GRID, RIM] = ["ink", "card", "line", "rim"].map(style), dusk = matchMedia("(prefers-color-scheme: dark)"), DARK = dusk.matches;
dusk.addEventListener("change", () => location.reload());

/* A colour of a white page; on a dark one it is mixed with white. */
const tone = colour => !DARK ? colour : "#" + [1, 3, 5].map(k => Math.round(0.6 * parseInt(colour.slice(k, k + 2), 16) + 102).toString(16)).join("");
const PICTURE = DATA.picture, colourOf = (name, usual) => PICTURE.colours[name] || tone(usual);
for (const robot of [...DATA.robots, ...DATA.innovations]) robot.colour = colourOf(robot.name, robot.colour);
const BLUE = tone("#1f5fa8"), BAND = DARK ? "rgba(121,159,203,0.25)" : "rgba(31,95,168,0.13)";
const TRUTH = PICTURE.colours.truth || (SPACE ? "#9aa1ab" : "rgba(139,146,156,0.6)"), FIX = tone("#7a3fa0"), GROUND = RIM, TAG = BLUE;
const POSE = tone("#d62f2f"), LINE = colourOf("lines", "#8c1c13"), ALARM = tone("#b3261e"), KNOWN = tone("#2f7d4f"), NAME = tone("#1e4d2b");
const MEASURED = colourOf("measured", "#7d838d"), SEGMENT = PICTURE.colours.measured || "rgba(58,104,200,0.55)";
const SIGMAS = PICTURE.sigmas ? `, ${PICTURE.sigmas} sigma ${DATA.ellipses}` : "";
const GROUPS = !SPACE ? [[colourOf("landmarks", "#d2691e"), `landmarks${SIGMAS}`]] :
  [[colourOf("landmarks", "#1f5fa8"), `landmarks${SIGMAS}`], [colourOf("others", "#c8412f"), `landmarks that are not Euclidean${SIGMAS}`],
   [LINE, `lines${SIGMAS}${SIGMAS && ", of their ends"}`]];

/* Points with what `value` (axis) gives of each axis. */
const along = (value, axes = AXES) => Object.fromEntries([...axes].map(k => [k, value(k)]));

/* Nothing where a point of space lies outside the box: points at great depth would shrink all the rest to a dot. */
function boxed(p) {
  if (!SPACE) return p;
  const {low, high} = DATA.box, keep = p.x.map((_, i) => AXES.every((k, a) => p[k][i] >= low[a] && p[k][i] <= high[a]));
  return {...p, ...along(k => p[k].map((v, i) => keep[i] ? v : null))};
}

/* The n-sigma contours of the Gaussians `rows` as one broken line, mean + n L c with P = L L': ellipses, in space three
   great circles of each ellipsoid. */
function contours(g, rows, points = 24, axes = AXES, sigmas = PICTURE.sigmas) {
  const out = along(() => [], axes), circles = !sigmas ? [] : axes.length === 2 ? [[0, 1]] : [[0, 1], [1, 2], [0, 2]];
  for (const i of rows) {
    if (g.pxx[i] === null || g.x[i] === null) continue;
    const L = [];
    for (let a = 0; a < axes.length; a++) {
      L.push([0, 0, 0]);
      for (let b = 0; b <= a; b++) {
        let rest = g["p" + axes[b] + axes[a]][i];
        for (let c = 0; c < b; c++) rest -= L[a][c] * L[b][c];
        L[a][b] = a === b ? Math.sqrt(Math.max(rest, 0)) : L[b][b] ? rest / L[b][b] : 0;
      }
    }
    for (const [u, v] of circles) {
      for (let k = 0; k <= points; k++) {
        const c = sigmas * Math.cos(2 * Math.PI * k / points), s = sigmas * Math.sin(2 * Math.PI * k / points);
        L.forEach((row, a) => out[axes[a]].push(g[axes[a]][i] + row[u] * c + row[v] * s));
      }
      for (const k of axes) out[k].push(null);
    }
  }
  return axes.length === 3 ? boxed(out) : out;
}

/* A polyline of a robot's frame placed at a pose of it, nothing if that is not known. */
function placed(body, r, i) {
  if (i < 0 || r.x[i] === null) return along(() => []);
  if (!SPACE) {
    const c = Math.cos(r.theta[i]), s = Math.sin(r.theta[i]), y = body.y;
    return {x: body.x.map((v, k) => v === null ? null : r.x[i] + c * v - s * y[k]), y: body.x.map((v, k) => v === null ? null : r.y[i] + s * v + c * y[k])};
  }
  const [x, y, z, w] = r.q.map(q => q[i]);
  const Q = [[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
             [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
             [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]];
  const turned = a => body.x.map((v, k) => v === null ? null : r[AXES[a]][i] + Q[a][0] * v + Q[a][1] * body.y[k] + Q[a][2] * body.z[k]);
  return {x: turned(0), y: turned(1), z: turned(2)};
}

const KIND = SPACE ? {type: "scatter3d", connectgaps: false} : {}, quiet = {showlegend: false};
const WAY = `true path and robot${DATA.how}`;
const WHERE = AXES.map(k => `%{${k}:.3f}`).join(", ");

/* A line of the map; widths are those of the plane, in space lines are thinner than they are said to be. */
const stroke = (points, color, width, extra) =>
  ({...KIND, ...points, mode: "lines", line: {color, width: SPACE ? 2.5 * width : width}, hoverinfo: "skip", ...extra});

/* Marks of the map, which are of a size of their own in space. */
const marks = (points, marker, sizes, extra) =>
  ({...KIND, ...points, mode: "markers", marker: {...marker, size: sizes[+SPACE]}, ...extra});

/* A thin cross: a line in the plane, in space a symbol of its own. */
const thin = (symbol, color) => SPACE ? {symbol, color} : {symbol: `${symbol}-thin`, color, line: {color, width: 1}};

function ground() {
  const {low, high} = DATA.box, size = Math.max(high[0] - low[0], high[1] - low[1]), z = low[2] <= 0 && high[2] >= 0 ? 0 : low[2];
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
  return stroke(grid, GROUND, 0.4, quiet);
}

/* What does not move with the slider: ground, fixes, truth. */
function still() {
  const traces = SPACE ? [ground()] : [], l = DATA.trueLandmarks;
  const each = (things, name, draw) => things.forEach((f, i) => traces.push({...draw(f), name, legendgroup: name, showlegend: i === 0}));
  const skip = {hoverinfo: "skip"};
  each(Object.values(DATA.fixes), "position fixes (aligned, not used)", f => marks(f, {color: TRUTH}, [3, 2], skip));
  each(Object.values(DATA.usedFixes), "fixes used", f => marks(f, thin("x", FIX), [5, 2], skip));
  const thinly = r => { const s = stroke(r.dead, r.colour, 0.9, {opacity: 0.5}); return {...s, line: {...s.line, dash: "dash"}}; };
  each(DATA.robots.filter(r => r.dead), "dead reckoning", thinly);
  each(DATA.robots.filter(r => PICTURE.truth && r.truth), WAY, r => stroke(along(k => broken(r.truth[k], r.gaps)), TRUTH, SPACE ? 1.6 : 3));
  if (DATA.repeats.x.length) traces.push(stroke(DATA.repeats, ALARM, 1.2, {...skip, name: "landmarks mapped twice"}));
  if (PICTURE.truth && DATA.trueLines.x.length) traces.push(stroke(DATA.trueLines, TRUTH, 1.6, {name: `true lines${DATA.how}`}));
  if (PICTURE.truth && l.x.length)
    traces.push(marks({...boxed(l), text: l.id}, thin("cross", SPACE ? "#8b929c" : INK), [8, 3],
                      {name: `true landmarks${DATA.how}`, hovertemplate: `true %{text}: ${WHERE}<extra></extra>`}));
  for (const [name, places] of Object.entries(DATA.classes))
    traces.push(marks(boxed(places), {color: name}, [5, 2], {...skip, name}));
  if (DATA.unseenLandmarks.x.length)
    traces.push(marks(boxed(DATA.unseenLandmarks), thin("x", ALARM), [6, 3], {...skip, name: "landmarks not seen again"}));
  const known = DATA.knownLandmarks;
  if (known.x.length)
    traces.push(marks({...boxed(known), text: known.id}, {symbol: SPACE ? "diamond-open" : "triangle-up-open", color: KNOWN}, [9, 4],
                      {name: "landmarks known exactly", hovertemplate: `%{text}, known exactly: ${WHERE}<extra></extra>`}));
  return traces;
}

/* The body of a robot at a pose: a filled outline in the plane, lines in space. */
function bodyAt(r, poses, i, colour, extra) {
  const body = stroke(placed(DATA.bodies[r.name], poses, i), colour, 1.2, extra);
  return SPACE ? body : {...body, fill: "toself", fillcolor: colour, line: {color: PAPER, width: 1}};
}

/* A map that was kept, and the robots at a time. */
function moving(map, now) {
  const traces = [], many = map.count > 100, corners = !SPACE || !many ? 24 : map.count > 1000 ? 4 : 8;
  GROUPS.forEach(([color, name], group) => {
    const rows = map.group.flatMap((g, i) => SPACE && g !== group ? [] : [i]), pick = k => rows.map(i => map[k][i]);
    const sigma = rows.map(i => map.pxx[i] === null ? null : Math.sqrt(Math.max(AXES.reduce((sum, k) => sum + map["p" + k + k][i], 0), 0)));
    const shown = rows.length > 0 || DATA.maps.some(m => m.group.includes(group)), width = SPACE ? (many ? 0.4 : 0.8) : many ? 0.7 : 1.1;
    traces.push(stroke(contours(map, rows, corners), color, width,
                       {name, legendgroup: name, showlegend: shown, opacity: SPACE ? 0.6 : 1}));
    traces.push(marks({...boxed(along(pick)), text: pick("id"), customdata: sigma}, {color, symbol: many && SPACE ? "square" : "circle"}, many ? [3, 1.8] : [5, 3],
                      {legendgroup: name, ...quiet, mode: PICTURE.labels ? "markers+text" : "markers", textposition: "top center",
                       textfont: {size: 10}, hovertemplate: `%{text}: ${WHERE}<br>sigma %{customdata:.3g} m<extra></extra>`}));
  });
  traces.push(stroke(boxed(map.lines), LINE, SPACE ? 1.6 : 2.2, quiet));
  if (SPACE) traces.push(stroke(map.tags, TAG, 1.2, quiet));
  DATA.robots.forEach((r, i) => {
    const n = upTo(r.t, now), name = DATA.robots.length > 1 ? r.name : "estimated path", at = n ? [n - 1] : [];
    const own = {legendgroup: r.name, ...quiet};
    traces.push(stroke(pathOf(r, n, AXES), r.colour, 1.6, {name, legendgroup: r.name}));
    const dotted = stroke(bridgesOf(r, n, AXES), r.colour, 1.6, own);
    traces.push({...dotted, line: {...dotted.line, dash: "dot"}});
    if (PICTURE.truth && r.truth)
      traces.push(bodyAt(r, r.truth, n - 1, colourOf("truth", "#7b828c"), {legendgroup: WAY, ...quiet, hoverinfo: "all", hovertemplate: `true ${r.name}: ${WHERE}<extra></extra>`}));
    traces.push(bodyAt(r, r, n - 1, r.colour, {...own, hoverinfo: "all", hovertemplate: `${r.name}: ${WHERE}<extra></extra>`}));
    traces.push(stroke(contours(r, at, 48), SPACE ? POSE : r.colour, SPACE ? 0.8 : 1.4,
                       {name: `robot${SIGMAS}`, legendgroup: "pose", showlegend: SPACE && i === 0}));
  });
  return traces;
}

function planarPage() {
  const [x, y] = [0, 1].map(a => [DATA.box.low[a], DATA.box.high[a]]), width = el("map").clientWidth || 1080;
  const most = Math.min(820, Math.max(480, innerHeight - 130));  /* with the slider on one screen */
  const height = Math.min(most, Math.max(360, (width - 80) * (y[1] - y[0]) / (x[1] - x[0]) + 120));
  return layout({height, uirevision: "map", xaxis: {...axis("x (m)"), range: x},
                 yaxis: {...axis("y (m)"), range: y, scaleanchor: "x"}, margin: {l: 64, r: 16, t: 32, b: 44},
                 legend: {orientation: "h", y: -48 / (height - 100), yanchor: "top"}});
}

/* The camera of the picture's view: in perspective, or from the top, the side or the front without. */
function cameraOf(eye) {
  const center = {x: 0, y: 0, z: eye ? 0 : -0.18};
  if (!eye) return {center, eye: {x: 0.95, y: -1.4, z: 0.9}, up: {x: 0, y: 0, z: 1}};
  return {center, eye: along(k => (PICTURE.flat ? 1.1 : 1.9) * eye["xyz".indexOf(k)]), up: Math.abs(eye[2]) > 0.99 ? {x: 0, y: 1, z: 0} : {x: 0, y: 0, z: 1},
          projection: {type: PICTURE.flat ? "orthographic" : "perspective"}};
}

/* The camera turned about the vertical, as it is while an orbit is played. */
function turned(camera, degrees) {
  const c = Math.cos(degrees * Math.PI / 180), s = Math.sin(degrees * Math.PI / 180), {x, y, z} = camera.eye;
  return {...camera, eye: {x: c * x - s * y, y: s * x + c * y, z}};
}

/* The box of space: its sides, and how many metres are one unit of plotly's scene. */
function spaceBox() {
  const {low, high} = DATA.box, spans = high.map((v, a) => v - low[a]);
  return {low, high, spans, unit: Math.max(...spans) / (PICTURE.flat ? 2 : 1.05)};
}

/* The camera behind a robot at a time, which looks along its x axis: elevation, azimuth and distance are the picture's. */
function cameraBehind(r, now) {
  const {low, high, unit} = spaceBox(), at = Math.max(upTo(r.t, now) - 1, 0), [x, y, z, w] = r.q.map(q => q[at]);
  const [elevation, turn, distance] = PICTURE.behind, rad = Math.PI / 180, cos = Math.cos(elevation * rad);
  const azimuth = turn * rad + Math.atan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z));
  const center = along(k => (r[k][at] - (low["xyz".indexOf(k)] + high["xyz".indexOf(k)]) / 2) / unit);
  const away = {x: cos * Math.cos(azimuth), y: cos * Math.sin(azimuth), z: Math.sin(elevation * rad)};
  return {center, eye: along(k => center[k] + distance / unit * away[k]), up: {x: 0, y: 0, z: 1}};
}

function spatialPage() {
  const {low, high, spans, unit} = spaceBox();
  const side = (title, a) => ({title: {text: title}, range: [low[a], high[a]], backgroundcolor: PAPER, gridcolor: GRID,
                               zerolinecolor: GRID, showspikes: false});
  return layout({height: 640, uirevision: "map", margin: {l: 0, r: 0, t: 0, b: 0}, legend: {orientation: "h", y: 0.02, x: 0.02},
    scene: {aspectmode: "manual", aspectratio: {x: spans[0] / unit, y: spans[1] / unit, z: spans[2] / unit}, uirevision: "map",
            xaxis: side("x (m)", 0), yaxis: side("y (m)", 1), zaxis: side("z (m)", 2),
            camera: cameraOf(PICTURE.eye), dragmode: PICTURE.flat ? "orbit" : "turntable"}});
}

/* The picture of a map: a function that draws the map of a number and the robots at a time, and images if they are in view. */
function mapPicture() {
  if (PICTURE.sensorWidth) el("images").style.gridTemplateColumns = `repeat(auto-fit, min(100%, ${PICTURE.sensorWidth}px))`;
  const background = still(), page = SPACE ? spatialPage() : planarPage();
  let shownMap = 0;
  const images = () => DATA.cameras.forEach((camera, i) => drawImages(camera, i, shownMap));
  if (DATA.cameras.length) inView("images", images);
  return (kept, now, playing) => {
    shownMap = kept;
    const shown = el("map")._fullLayout?.scene?._scene;  /* the slider must not turn the view back */
    if (SPACE && PICTURE.behind) Object.assign(page.scene, {camera: cameraBehind(DATA.robots[0], now), uirevision: now});
    else if (shown) page.scene.camera = PICTURE.orbit && playing ? turned(shown.getCamera(), 3) : shown.getCamera();
    Plotly.react("map", [...background, ...moving(DATA.maps[kept], now)], page, CONFIG);
    if (!waiting.has(el("images"))) images();
    drawCovariance(DATA.maps[kept]);
  };
}

/* The correlations of a map that was kept, of which large maps have none. */
function drawCovariance(map) {
  const words = document.querySelector("#covariance figcaption"), picture = new Image();
  if (map.P) Object.assign(picture, {src: map.P, alt: "correlations of P"});
  el("covariance").replaceChildren(...(map.P ? [picture] : []), words);
  words.textContent = map.P ? `P at ${map.t.toFixed(2)} s: correlations of robots, then landmarks; blue -1, white 0, red 1` :
    `P is not kept here: the map has more than ${DATA.correlationsOf} landmarks`;
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
  const shown = image.picture ? colour => colour : tone;  /* on the paper, or on an image */
  const {size} = camera, lines = new Map(), marks = {new: [], rejected: [], measured: []}, names = {x: [], y: [], text: []};
  const add = (colour, name, dash, width, points) => {
    const key = colour + dash;
    if (!lines.has(key)) lines.set(key, {x: [], y: [], mode: "lines", line: {color: colour, width, dash}, name, hoverinfo: "skip"});
    for (const p of points) { lines.get(key).x.push(p[0]); lines.get(key).y.push(p[1]); }
    lines.get(key).x.push(null);
    lines.get(key).y.push(null);
  };
  for (const s of image.seen) {
    const single = (s.e || s.y).length === 1, close = p => p.length > 2 ? [...p, p[0]] : p, dash = s.outcome === "rejected" ? "dot" : "solid";
    if (s.y.length && single) marks.measured.push([...s.y[0], s.name]); else if (s.y.length) add(SEGMENT, "measured", "solid", 4, close(s.y));
    if (s.outcome in marks) marks[s.outcome].push(...s.y.map(p => [...p, s.name]));
    if (s.e && single && s.Z) {
      const e = contours({x: [s.e[0][0]], y: [s.e[0][1]], pxx: [s.Z[0]], pxy: [s.Z[1]], pyy: [s.Z[2]]}, [0], 32, "xy", 3);
      add(shown(s.colour), s.meaning, dash, 1.4, e.x.slice(0, -1).map((x, k) => [x, e.y[k]]));
    } else if (s.e) add(shown(s.colour), s.meaning, dash, 1.4, s.e.length === 2 ? trimmed(s.e, size) : close(s.e));
    if (s.name && s.outcome !== "ignored" && image.seen.length <= 30) {
      const at = s.e && single ? s.e : s.y, mean = a => at.reduce((sum, p) => sum + p[a], 0) / at.length;
      names.x.push(mean(0)); names.y.push(mean(1) - 15); names.text.push(s.name);
    }
  }
  const dots = (points, name, marker) => ({x: points.map(p => p[0]), y: points.map(p => p[1]), text: points.map(p => p[2]), name,
    mode: "markers", marker, hovertemplate: `%{text} ${name}: %{x:.1f}, %{y:.1f}<extra></extra>`, showlegend: points.length > 0});
  const high = (el(id).clientWidth || 500) * size[1] / size[0];  /* below the image its ticks, then a legend of two rows at most */
  const picture = image.picture ? [{source: image.picture, xref: "x", yref: "y", x: -0.5, y: -0.5, sizex: size[0], sizey: size[1],
    sizing: "stretch", layer: "below"}] : [];
  const title = `${camera.name}${image.side ? " · " + image.side : ""}${scan ? ` · ${scan.t.toFixed(2)} s` : ""}`;
  Plotly.react(id, [
    dots(marks.measured, "measured", {symbol: "cross-thin", size: 9, line: {color: PICTURE.colours.measured || (image.picture ? "#ffd400" : MEASURED), width: 1.3}}), ...lines.values(),
    dots(marks.new, "new", {symbol: "square-open", size: 10, color: NAME}),
    dots(marks.rejected, "rejected", {symbol: "x-thin", size: 9, line: {color: INK, width: 1.6}}),
    {...names, mode: "text", textfont: {size: 10, color: NAME}, hoverinfo: "skip", showlegend: false}],
    layout({height: high + 100, title: {text: title, x: 0.01, font: {size: 13}}, margin: {l: 44, r: 10, t: 30, b: 70},
            images: picture,
            xaxis: {...axis(""), range: [0, size[0]], constrain: "domain", mirror: true, showline: true},
            yaxis: {...axis(""), range: [size[1], 0], scaleanchor: "x", constrain: "domain", mirror: true, showline: true},
            showlegend: true, legend: {orientation: "h", y: -24 / high, yanchor: "top", x: 0, font: {size: 11}}}), {...CONFIG, displayModeBar: false});
}
