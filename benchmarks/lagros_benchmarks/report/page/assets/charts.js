// Figures of the rows, as drawings that print.
const WIDTH = 420, HEIGHT = 270, LEFT = 52, RIGHT = 12, TOP = 14, BOTTOM = 42;

function ticks(low, high, log) {
  if (log) {
    const found = [];
    for (let power = Math.floor(Math.log10(low)); power <= Math.log10(high) + 1; power++) {
      for (const lead of high / low < 50 ? [1, 2, 5] : [1]) found.push(lead * 10 ** power);
    }
    const inside = found.filter((one) => one >= low * 0.999 && one <= high * 1.001);
    return inside.filter((_, k) => k % Math.ceil(inside.length / 6) === 0);
  }
  const rough = (high - low) / 5 || 1, power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((lead) => lead * power).find((one) => one >= rough);
  const found = [];
  for (let k = Math.ceil(low / step); k * step <= high * (1 + 1e-9); k++) found.push(k * step);
  return found;
}

// Axes of a figure: places of values, and a group to draw in.
function axes(x, y) {
  const place = (range, from, to) => (value) => {
    const turn = range.log ? Math.log : (one) => one;
    const share = (turn(value) - turn(range.low)) / (turn(range.high) - turn(range.low) || 1);
    return from + share * (to - from);
  };
  const across = place(x, LEFT, WIDTH - RIGHT), up = place(y, HEIGHT - BOTTOM, TOP);
  const inside = svg("g", {});
  const picture = svg("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img" });
  for (const value of y.ticks || ticks(y.low, y.high, y.log)) {
    picture.append(
      svg("line", { x1: LEFT, x2: WIDTH - RIGHT, y1: up(value), y2: up(value), stroke: "#e4e4e4" }),
      svg("text", { x: LEFT - 6, y: up(value) + 4, "text-anchor": "end" }, number(value)));
  }
  for (const value of x.ticks || ticks(x.low, x.high, x.log)) {
    picture.append(
      svg("line", { x1: across(value), x2: across(value), y1: HEIGHT - BOTTOM, y2: HEIGHT - BOTTOM + 4,
        stroke: "#8a8a8a" }),
      svg("text", { x: across(value), y: HEIGHT - BOTTOM + 17, "text-anchor": "middle" }, number(value)));
  }
  picture.append(
    svg("line", { x1: LEFT, x2: WIDTH - RIGHT, y1: HEIGHT - BOTTOM, y2: HEIGHT - BOTTOM, stroke: "#8a8a8a" }),
    svg("text", { x: (LEFT + WIDTH - RIGHT) / 2, y: HEIGHT - 6, "text-anchor": "middle" }, x.label),
    svg("text", { x: 0, y: 0, "text-anchor": "middle",
      transform: `translate(12 ${(TOP + HEIGHT - BOTTOM) / 2}) rotate(-90)` }, y.label),
    inside);
  return { picture, inside, across, up };
}

const path = (points) => {
  let text = "", pen = false;
  for (const [x, y] of points) {
    const there = isFinite(x) && isFinite(y);
    if (there) text += `${pen ? "L" : "M"}${x.toFixed(1)} ${y.toFixed(1)}`;
    pen = there;
  }
  return text;
};

function curve(frame, points, series, name) {
  return svg("path", { d: path(points.map(([x, y]) => [frame.across(x), frame.up(y)])), fill: "none",
    stroke: series.colour, "stroke-width": 2, "stroke-dasharray": series.dashes || null },
    svg("title", {}, name));
}

// A value with its interval, upright or lying.
function whisker(frame, x, y, ends, series, lying, title) {
  const group = svg("g", {}, svg("title", {}, title));
  if (ends) {
    const [a, b] = ends.map(lying ? frame.across : frame.up);
    const at = lying ? frame.up(y) : frame.across(x);
    group.append(svg("line", { x1: lying ? a : at, x2: lying ? b : at, y1: lying ? at : a,
      y2: lying ? at : b, stroke: series.colour, "stroke-width": 1.5 }));
  }
  group.append(marker(frame.across(x), frame.up(y), series));
  return group;
}

const interval = (row) => row.figures.success_world_ci95 || row.figures.success_ci95;
const hundred = (ends) => (ends ? ends.map((one) => 100 * one) : null);
const clipped = (range, value) => Math.min(Math.max(value, range.low), range.high);

const PERCENT = { low: -3, high: 103, ticks: [0, 25, 50, 75, 100], label: "success [%]" };

// Success against the bound, of the kind of disturbance that is chosen.
function successChart(chosen) {
  const alike = DATA.conditions.map((one, index) => ({ ...one, index }))
    .filter((one) => one.kind === chosen.kind && one.agents === chosen.agents);
  const bounds = [...new Set(alike.map((one) => one.bound))].sort((a, b) => a - b);
  const title = `Success against the bound, ${chosen.kind}`;
  const at = new Map(alike.map((one) => [one.index, one.bound]));
  const widen = 0.08 * (bounds[bounds.length - 1] - bounds[0]) || 0.5 * (bounds[0] || 1);
  const x = { low: bounds[0] - widen, high: bounds[bounds.length - 1] + widen, label: "d̄ [state units/s]",
    ticks: bounds.length < 7 ? bounds : null };
  const frame = axes(x, { ...PERCENT });
  DATA.series.forEach((series, index) => {
    // Beside each other, where values are the same.
    const shift = 0.012 * (index - (DATA.series.length - 1) / 2) * (x.high - x.low) * (bounds.length > 1 ? 1 : 4);
    const rows = DATA.rows.filter((row) => row.series === index && at.has(row.condition))
      .sort((a, b) => at.get(a.condition) - at.get(b.condition));
    const points = rows.map((row) => [at.get(row.condition) + shift, 100 * row.figures.success_rate]);
    frame.inside.append(curve(frame, points, series, series.label));
    rows.forEach((row, k) => frame.inside.append(whisker(frame, ...points[k], hundred(interval(row)), series,
      false, `${series.label}, d̄ = ${at.get(row.condition)}: ${number(points[k][1])} %`)));
  });
  return [title, frame.picture];
}

// The mean error over time against the tubes; of many agents, the largest errors.
function errorChart(rows) {
  const curves = rows.filter((row) => row.figures.mean_tracking_error);
  if (!curves.length) return errorDots(rows);
  const times = curves[0].figures.time_s, tubes = [];
  const paper = curves[0].figures.paper_tube;
  if (paper) tubes.push({ values: paper, series: { colour: "#000", dashes: "6 3" }, name: "published tube" });
  for (const row of curves) {
    if (row.figures.certified_tube) {
      tubes.push({ values: row.figures.certified_tube, name: `proved of ${DATA.series[row.series].label}`,
        series: { colour: "#000", dashes: "2 2" } });
    }
  }
  const ends = curves.map((row) => Math.max(...row.figures.mean_tracking_error.filter((one) => one != null)));
  const tops = tubes.map((one) => Math.max(...one.values));
  const highest = Math.max(...ends, ...tops), least = Math.min(...ends, ...tops);
  const log = highest > 15 * least;
  const y = { low: log ? 0.03 * least : 0, high: 1.05 * highest, log, label: "‖x − x_d‖, mean, 10–90 %" };
  const frame = axes({ low: 0, high: times[times.length - 1], label: "t [s]" }, y);
  for (const row of curves) {
    const series = DATA.series[row.series], figures = row.figures;
    const points = (values) => times.map((t, k) => [t, values[k] == null ? NaN : clipped(y, values[k])]);
    const { tracking_error_p10: low, tracking_error_p90: high } = figures;
    const area = [...points(low), ...points(high).reverse()].filter((one) => isFinite(one[1]));
    frame.inside.append(
      svg("path", { d: `${path(area.map(([t, v]) => [frame.across(t), frame.up(v)]))}Z`,
        fill: series.colour, opacity: 0.13 }),
      curve(frame, points(figures.mean_tracking_error), series, series.label));
  }
  for (const tube of tubes) {
    frame.inside.append(curve(frame, times.map((t, k) => [t, clipped(y, tube.values[k])]), tube.series, tube.name));
  }
  const drawn = [...new Set(tubes.map((one) => one.name))].slice(0, 3).join(", ");
  return [`Error against the tube${drawn ? ` (black: ${drawn})` : ": this task publishes none"}`, frame.picture];
}

function errorDots(rows) {
  const known = rows.filter((row) => row.figures.position_error_max_median != null);
  if (!known.length) return null;
  const highest = Math.max(...known.map((row) => row.figures.position_error_max_p95));
  const x = { low: 0, high: 1.08 * highest || 1, label: "largest ‖p − p_d‖ of an agent [m], median and 95th percentile" };
  const frame = axes(x, { low: -0.5, high: known.length - 0.5, ticks: [], label: "" });
  known.forEach((row, index) => {
    const series = DATA.series[row.series], { position_error_max_median: middle, position_error_max_p95: end } = row.figures;
    const at = known.length - 1 - index;
    frame.inside.append(whisker(frame, middle, at, [middle, end], series, true, series.label),
      svg("text", { x: frame.across(0) + 6, y: frame.up(at) - 10 },
        `${series.label}: ${number(100 * row.figures.tube_violation_rate)} % left the published tube`));
  });
  return ["Error of those that follow a plan", frame.picture];
}

// Effort against success, with the intervals of both.
function effortChart(rows) {
  const known = rows.filter((row) => row.figures.effort_mean != null);
  if (!known.length) return null;
  const all = known.flatMap((row) => [row.figures.effort_mean, ...(row.figures.effort_ci95 || [])]).filter((one) => one > 0);
  const highest = Math.max(...all, 1e-9), least = Math.min(...all, highest);
  const log = highest > 12 * least;
  const x = { low: log ? 0.8 * least : 0, high: (log ? 1.25 : 1.08) * highest, log,
    label: `mean effort${DATA.effort ? ` [${DATA.effort}]` : ""}` };
  const frame = axes(x, { ...PERCENT });
  for (const row of known) {
    const series = DATA.series[row.series], { effort_mean: effort, effort_ci95: spread } = row.figures;
    const success = 100 * row.figures.success_rate;
    const title = `${series.label}: ${number(effort)} ${DATA.effort}, ${number(success)} %`;
    frame.inside.append(
      whisker(frame, clipped(x, effort), success, spread ? spread.map((one) => clipped(x, one)) : null, series, true, title),
      whisker(frame, clipped(x, effort), success, hundred(interval(row)), series, false, title));
  }
  return ["Effort against success", frame.picture];
}

function drawCharts(condition) {
  const rows = DATA.rows.filter((row) => row.condition === condition);
  const made = [successChart(DATA.conditions[condition]), errorChart(rows), effortChart(rows)];
  byId("charts").replaceChildren(...made.filter(Boolean).map(([title, picture]) => {
    picture.setAttribute("aria-label", `${title}; its numbers are in the table`);
    return el("figure", {}, el("figcaption", {}, title), picture);
  }));
}
