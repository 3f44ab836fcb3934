// One episode as one policy flew it: the picture at a time, and its curves.
const INK = { body: "#0072b2", goal: "#009e73", plan: "#a04a7c", tube: "#56b4e9", push: "#000000", rate: "#d55e00",
  bad: "#d55e00", disc: "#e1e1e1", rim: "#6e6e6e", quiet: "#555555" };
const AGENTS = ["#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#b8a800"];
const MARGIN = 0.08, ARROW = 46, LEAST = 5;

const decoded = new WeakMap();
function decode(given) {
  if (!given) return null;
  if (!decoded.has(given)) {
    const all = (part) => Object.fromEntries(Object.entries(part || {}).map(([name, one]) => [name, unpacked(one)]));
    const plan = given.plan ? all(given.plan) : null;
    decoded.set(given, { times: unpacked(given.times), ...all(given.parts), measures: all(given.measures), plan });
  }
  return decoded.get(given);
}

const bodiesOf = (flight) => (flight.places ? flight.places.shape[1] : 1);

// Index and share of a time between two frames.
function frameAt(times, t) {
  const { values } = times;
  let low = 0, high = values.length - 1;
  if (t >= values[high]) return [high, 0];
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (values[middle] <= t) low = middle; else high = middle;
  }
  const span = values[high] - values[low];
  return [low, span > 0 ? Math.max(0, (t - values[low]) / span) : 0];
}

// The entries of an array at a time, on the line between two frames.
function entriesAt(array, times, t) {
  const [k, share] = frameAt(times, t), { values, width } = array, found = new Array(width);
  for (let j = 0; j < width; j++) {
    const a = values[k * width + j], b = share > 0 ? values[(k + 1) * width + j] : a;
    found[j] = a + share * (b - a);
  }
  return found;
}

// A canvas of so many pixels of the screen for each of the page.
function prepared(canvas, height) {
  const width = canvas.clientWidth || 400, dense = window.devicePixelRatio || 1;
  canvas.style.height = `${height}px`;
  if (canvas.width !== Math.round(width * dense) || canvas.height !== Math.round(height * dense)) {
    canvas.width = Math.round(width * dense);
    canvas.height = Math.round(height * dense);
  }
  const pen = canvas.getContext("2d");
  pen.setTransform(dense, 0, 0, dense, 0, 0);
  pen.clearRect(0, 0, width, height);
  pen.font = "12px system-ui, sans-serif";
  pen.lineJoin = "round";
  return [pen, width, height];
}

function sizeOf(view, width) {
  const span = (low, high) => Math.max(high - low, 1e-6);
  const wide = Math.max(span(view[0], view[2]), 1), high = Math.max(span(view[1], view[3]), 0.16 * wide);
  return Math.round(Math.min(Math.max((width * high) / wide, 130), 440));
}

// Metres to pixels, alike both ways, so that the view fits.
function camera(view, width, height, room) {
  const wide = Math.max(view[2] - view[0], 1) + 2 * room, high = Math.max(view[3] - view[1], 0.5) + 2 * room;
  const scale = Math.min(width / (wide * (1 + 2 * MARGIN)), height / (high * (1 + 2 * MARGIN)));
  const middle = [(view[0] + view[2]) / 2, (view[1] + view[3]) / 2];
  return { scale, at: (x, y) => [width / 2 + scale * (x - middle[0]), height / 2 - scale * (y - middle[1])] };
}

function polygons(pen, eye, corners, paint) {
  let k = 0;
  for (const count of DATA.corners) {
    pen.beginPath();
    for (let corner = 0; corner < count; corner++, k += 2) pen.lineTo(...eye.at(corners[k], corners[k + 1]));
    pen.closePath();
    paint();
  }
}

function ring(pen, eye, x, y, radius, least = 0) {
  pen.beginPath();
  pen.arc(...eye.at(x, y), Math.max(radius * eye.scale, least), 0, 2 * Math.PI);
}

function cross(pen, [x, y], arm) {
  pen.beginPath();
  for (const sign of [1, -1]) { pen.moveTo(x - arm, y - sign * arm); pen.lineTo(x + arm, y + sign * arm); }
  pen.stroke();
}

function arrow(pen, [x, y], across, up, colour) {
  const dx = ARROW * across, dy = -ARROW * up, length = Math.hypot(dx, dy);
  if (!(length > 3)) return;
  const [ux, uy] = [dx / length, dy / length], head = Math.min(9, length);
  pen.strokeStyle = pen.fillStyle = colour;
  pen.lineWidth = 2.5;
  pen.beginPath(); pen.moveTo(x, y); pen.lineTo(x + dx - head * ux, y + dy - head * uy); pen.stroke();
  pen.beginPath(); pen.moveTo(x + dx, y + dy);
  pen.lineTo(x + dx - head * ux - 0.5 * head * uy, y + dy - head * uy + 0.5 * head * ux);
  pen.lineTo(x + dx - head * ux + 0.5 * head * uy, y + dy - head * uy - 0.5 * head * ux);
  pen.fill();
}

function trail(pen, eye, array, times, body, t, colour, width, dashes) {
  const [last] = frameAt(times, t), bodies = array.shape[1], step = array.width / bodies;
  pen.strokeStyle = colour; pen.lineWidth = width; pen.setLineDash(dashes || []);
  pen.beginPath();
  for (let k = 0; k <= last; k++) {
    const at = k * array.width + body * step;
    pen.lineTo(...eye.at(array.values[at], array.values[at + 1]));
  }
  const now = entriesAt(array, times, t);
  pen.lineTo(...eye.at(now[body * step], now[body * step + 1]));
  pen.stroke();
  pen.setLineDash([]);
}

function drawScene(canvas, episode, given, t) {
  const { scene } = episode, flight = decode(given);
  const [pen, width, height] = prepared(canvas, sizeOf(scene.view, canvas.clientWidth || 400));
  if (!flight.places) {
    pen.fillStyle = INK.quiet; pen.textAlign = "center";
    pen.fillText("This task has no picture; its numbers and curves are below.", width / 2, height / 2);
    return;
  }
  const eye = camera(scene.view, width, height, scene.radius || 0);
  const bodies = flight.places.shape[1], step = flight.places.width / bodies;
  const places = entriesAt(flight.places, flight.times, t);
  const plan = flight.plan || decodedPlan(scene), end = given.ending;
  const over = end && t >= end.time - 1e-6;
  const colour = (body) => (bodies > 1 ? AGENTS[body % AGENTS.length] : INK.body);

  for (const [x, y, radius] of scene.discs) {
    ring(pen, eye, x, y, radius);
    pen.fillStyle = INK.disc; pen.fill();
    pen.strokeStyle = INK.rim; pen.lineWidth = 1; pen.stroke();
  }
  drawTube(pen, eye, flight, plan, t, bodies, height);
  scene.goals.forEach(([x, y, radius], body) => {
    pen.strokeStyle = bodies > 1 ? colour(body) : INK.goal; pen.lineWidth = 1.5;
    if (radius > 0) { ring(pen, eye, x, y, radius); pen.setLineDash([5, 4]); pen.stroke(); pen.setLineDash([]); }
    if (!scene.outline) { pen.lineWidth = 2; cross(pen, eye.at(x, y), 5); }
  });
  if (scene.outline) {
    pen.strokeStyle = INK.goal; pen.lineWidth = 2; pen.setLineDash([4, 3]);
    polygons(pen, eye, scene.outline.flat(), () => pen.stroke());
    pen.setLineDash([]);
  }
  if (plan) {
    const last = plan.times.values[plan.times.values.length - 1];
    for (let body = 0; body < bodies; body++) trail(pen, eye, plan.places, plan.times, body, last, INK.plan, 1, [2, 4]);
    if (plan.polygons) {
      pen.strokeStyle = INK.plan; pen.lineWidth = 1.5;
      polygons(pen, eye, entriesAt(plan.polygons, plan.times, t), () => pen.stroke());
    }
  }
  for (let body = 0; body < bodies; body++) {
    trail(pen, eye, flight.places, flight.times, body, t, `${colour(body)}99`, 1.8);
    const [x, y, heading] = places.slice(step * body, step * (body + 1));
    pen.fillStyle = colour(body);
    if (flight.polygons) {
      polygons(pen, eye, entriesAt(flight.polygons, flight.times, t), () => pen.fill());
    } else {
      const [px, py] = eye.at(x, y), size = Math.max(scene.radius * eye.scale, LEAST);
      pen.beginPath(); pen.arc(px, py, size, 0, 2 * Math.PI); pen.globalAlpha = 0.75; pen.fill(); pen.globalAlpha = 1;
      pen.strokeStyle = "#1a1a1a"; pen.lineWidth = 1.5;
      pen.beginPath(); pen.moveTo(px, py);
      pen.lineTo(px + size * Math.cos(heading), py - size * Math.sin(heading)); pen.stroke();
    }
  }
  if (flight.push) {
    const push = entriesAt(flight.push, flight.times, t + 1e-9), kinds = push.length / bodies;
    for (let body = 0; body < bodies; body++) {
      const from = eye.at(places[step * body], places[step * body + 1]), d = push.slice(kinds * body, kinds * (body + 1));
      arrow(pen, from, d[0], d[1], INK.push);
      if (kinds === 4) arrow(pen, from, d[2], d[3], INK.rate);
    }
  }
  if (bodies > 1) {
    pen.fillStyle = "#1a1a1a"; pen.textAlign = "center"; pen.font = "bold 11px system-ui, sans-serif";
    const name = (body, x, y) => { const [px, py] = eye.at(x, y); pen.fillText(body, px, py - Math.max(scene.radius * eye.scale, LEAST) - 3); };
    scene.goals.forEach(([x, y], body) => name(body, x, y));
    for (let body = 0; body < bodies; body++) name(body, places[step * body], places[step * body + 1]);
  }
  for (const event of given.events) {
    if (event.time > t + 1e-6) continue;
    const [x, y] = places.slice(step * event.body);
    pen.lineWidth = event.kind === "collision" ? 3 : 2;
    pen.strokeStyle = event.kind === "collision" ? INK.bad : "#1a1a1a";
    ring(pen, eye, x, y, scene.radius, LEAST); pen.stroke();
    if (event.kind === "collision") cross(pen, eye.at(x, y), Math.max(0.7 * scene.radius * eye.scale, 6));
  }
  if (over) failure(pen, eye, places.slice(step * end.body), end, scene, width);
  scaleBar(pen, eye, width, height);
}

// The published tube around the plan, and what is proved; where a body has no position, their reach in the picture.
function drawTube(pen, eye, flight, plan, t, bodies, height) {
  if (!plan) return;
  const now = entriesAt(plan.places, plan.times, t), spread = plan.spread ? entriesAt(plan.spread, plan.times, t) : [1, 1];
  for (const [name, dashes] of [["tube", []], ["proved", [2, 3]]]) {
    const radii = flight.measures[name];
    if (!radii) continue;
    const [radius] = entriesAt(radii, flight.times, t), [a, b] = [radius * spread[0], radius * spread[1]];
    pen.strokeStyle = INK.tube; pen.lineWidth = 1.5; pen.setLineDash(dashes);
    for (let body = 0; body < bodies; body++) {
      const step = plan.places.width / bodies, [x, y] = eye.at(now[step * body], now[step * body + 1]);
      pen.beginPath();
      if (b * eye.scale < 1 && a > 0) pen.rect(x - a * eye.scale, 4, 2 * a * eye.scale, height - 8);
      else pen.ellipse(x, y, a * eye.scale, b * eye.scale, 0, 0, 2 * Math.PI);
      pen.fillStyle = "rgba(86, 180, 233, 0.14)"; pen.fill(); pen.stroke();
    }
    pen.setLineDash([]);
  }
}

function decodedPlan(scene) {
  if (!scene.plan) return null;
  if (!decoded.has(scene.plan)) {
    decoded.set(scene.plan, Object.fromEntries(Object.entries(scene.plan).map(([name, one]) => [name, unpacked(one)])));
  }
  return decoded.get(scene.plan);
}

function failure(pen, eye, [x, y], end, scene, width) {
  const [px, py] = eye.at(x, y);
  pen.strokeStyle = INK.bad; pen.lineWidth = 3;
  ring(pen, eye, x, y, scene.radius || 0, 16); pen.stroke();
  const text = `${end.label}, ${end.time.toFixed(1)} s`;
  pen.font = "bold 13px system-ui, sans-serif"; pen.textAlign = "center";
  const half = pen.measureText(text).width / 2 + 6, at = Math.min(Math.max(px, half), width - half);
  const up = Math.max(py - 26, 22);
  pen.fillStyle = "#ffffffe0"; pen.fillRect(at - half, up - 15, 2 * half, 20);
  pen.fillStyle = "#a63c00"; pen.fillText(text, at, up);
}

function scaleBar(pen, eye, width, height) {
  const length = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50].find((one) => one * eye.scale > 30) || 100;
  pen.strokeStyle = INK.quiet; pen.fillStyle = INK.quiet; pen.lineWidth = 2; pen.textAlign = "left";
  pen.font = "12px system-ui, sans-serif";
  pen.beginPath(); pen.moveTo(10, height - 12); pen.lineTo(10 + length * eye.scale, height - 12); pen.stroke();
  pen.fillText(`${length} m`, 16 + length * eye.scale, height - 8);
}

// Curves over time, one below the other, with a line at the time that is shown.
function drawCurves(canvas, given, t, duration) {
  const flight = decode(given), { measures } = flight, lines = [];
  if (measures.error) lines.push([bodiesOf(flight) > 1 ? "largest ‖x − x_d‖" : "‖x − x_d‖", measures.error, [["tube", measures.tube], ["proved", measures.proved]]]);
  lines.push([bodiesOf(flight) > 1 ? "largest distance to a goal" : "distance to the goal", measures.distance, [["radius", measures.radius]]]);
  const each = 74, [pen, width] = prepared(canvas, each * lines.length + 4), left = 50, right = 8;
  const across = (time) => left + ((width - left - right) * time) / (duration || 1);
  lines.forEach(([name, values, bounds], line) => {
    const top = each * line + 20, bottom = each * (line + 1) - 4;
    const limits = bounds.filter(([, one]) => one);
    const reach = (one) => Math.max(...one.values.filter((value) => isFinite(value)), 0);
    // What flies away shall not flatten the rest.
    const usual = Math.max(...limits.map(([, one]) => reach(one)), values.values[0]);
    const highest = 1.08 * (usual > 0 ? Math.min(Math.max(reach(values), usual), 4 * usual) : reach(values)) || 1;
    const up = (value) => bottom - ((bottom - top) * value) / highest;
    const draw = (one, colour, dashes) => {
      pen.save(); pen.beginPath(); pen.rect(left, top - 2, width, bottom - top + 3); pen.clip();
      pen.strokeStyle = colour; pen.lineWidth = 1.8; pen.setLineDash(dashes); pen.beginPath();
      flight.times.values.forEach((time, k) => {
        if (isFinite(one.values[k])) pen.lineTo(across(time), up(one.values[k]));
      });
      pen.stroke(); pen.restore();
    };
    pen.strokeStyle = "#b0b0b0"; pen.lineWidth = 1;
    pen.beginPath(); pen.moveTo(left, top); pen.lineTo(left, bottom); pen.lineTo(width - right, bottom); pen.stroke();
    pen.fillStyle = INK.quiet; pen.textAlign = "left";
    pen.fillText([name, ...limits.map(([title]) => title)].join(" · "), left, top - 7);
    pen.textAlign = "right"; pen.fillText(number(highest), left - 5, top + 8); pen.fillText("0", left - 5, bottom);
    limits.forEach(([title, one]) => draw(one, "#1f8ac0", title === "proved" ? [2, 3] : [6, 3]));
    draw(values, "#1a1a1a", []);
    if (given.ending) {
      pen.strokeStyle = INK.bad; pen.lineWidth = 1.5; pen.setLineDash([3, 3]);
      pen.beginPath(); pen.moveTo(across(given.ending.time), top); pen.lineTo(across(given.ending.time), bottom); pen.stroke();
      pen.setLineDash([]);
    }
    pen.strokeStyle = INK.body; pen.lineWidth = 1.5;
    pen.beginPath(); pen.moveTo(across(t), top - 2); pen.lineTo(across(t), bottom); pen.stroke();
  });
  return (x) => ((x - left) / (width - left - right)) * duration;
}
