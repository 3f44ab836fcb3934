// Episodes to play, one policy beside another on the same one.
function makePlayer() {
  const state = { condition: 0, episodes: [], episode: null, sides: [null, null], t: 0, playing: false, last: 0 };
  const [episodeLabel, episodes] = choice("Episode", "episode", [], () => show(Number(episodes.value)));
  const sides = ["Left", "Right"].map((name, k) =>
    choice(name, `policy-${k}`, [], (event) => { state.sides[k] = event.target.value; cast(); }));
  byId("cast").append(episodeLabel, ...sides.map(([label]) => label));

  const stages = [0, 1].map(() => {
    const stage = { title: el("h3"), canvas: el("canvas", { role: "img", tabindex: 0 }), verdict: el("p", { class: "verdict" }),
      warning: el("p", { class: "warning" }), numbers: el("p", { class: "numbers" }), curves: el("canvas", { "aria-hidden": "true" }) };
    stage.root = el("div", { class: "stage" }, stage.title, stage.canvas, stage.verdict, stage.warning, stage.numbers, stage.curves);
    stage.curves.addEventListener("pointerdown", (event) => {
      if (stage.timeAt) seek(stage.timeAt(event.clientX - stage.curves.getBoundingClientRect().left));
    });
    return stage;
  });
  byId("stages").append(...stages.map((stage) => stage.root));

  const play = el("button", { type: "button", id: "play", onclick: toggle }, "▶ Play");
  const back = el("button", { type: "button", onclick: () => step(-1), "aria-label": "One step back" }, "◀");
  const on = el("button", { type: "button", onclick: () => step(1), "aria-label": "One step on" }, "▶");
  const slider = el("input", { type: "range", id: "time", min: 0, value: 0, "aria-label": "Time",
    oninput: () => seek(Number(slider.value) * state.period) });
  const clock = el("output", { for: "time" });
  const speeds = [...new Set([0.25, 0.5, 1, 2, 5, 10, DATA.speed])].sort((a, b) => a - b);
  const [speedLabel, speed] = choice("Speed", "speed", speeds.map((one) => [one, `× ${one}`]));
  speed.value = DATA.speed;
  byId("controls").append(play, back, on, slider, clock, speedLabel);
  byId("hint").textContent = "Keys: space plays and stops; ← → one step, with shift ten; Home and End"
    + (DATA.episodes.length > 1 ? "; N and P the next and the previous episode." : ".");

  const duration = () => Math.max(...shown().map(({ flight }) => lastOf(decode(flight).times)), state.period);
  const lastOf = (times) => times.values[times.values.length - 1];
  const shown = () => state.sides.map((side, k) => ({ side, stage: stages[k], flight: state.episode?.flights[side] }))
    .filter(({ flight }) => flight);

  function choose(condition) {
    state.condition = condition;
    state.episodes = DATA.episodes.filter((one) => one.condition === condition);
    byId("player").classList.toggle("empty", !state.episodes.length);
    option(episodes, state.episodes.map((one, k) => [k, title(one)]), 0);
    for (const part of ["cast", "seed", "stages", "controls", "scene-key"]) byId(part).hidden = !state.episodes.length;
    byId("hint").hidden = !state.episodes.length;
    episodeLabel.hidden = state.episodes.length < 2;
    if (state.episodes.length) show(0); else { state.episode = null; stop(); }
  }

  function title(one) {
    const why = one.why.map(([series, reason]) => `${DATA.series[series].label} ${reason}`);
    return `${one.index + 1}${why.length ? `: ${why.slice(0, 3).join("; ")}` : ""}${why.length > 3 ? "; …" : ""}`;
  }

  function show(index) {
    state.episode = state.episodes[index];
    const alone = Object.keys(state.episode.flights).length < 2;
    byId("seed").textContent = `Seed ${state.episode.seed}${alone ? "" : "; start, goal, discs and disturbance are the same for all"}.`;
    episodes.value = index;
    const there = Object.keys(state.episode.flights);
    const named = there.map((key) => [key, DATA.series[key].label]);
    option(sides[0][1], named, state.sides[0] ?? there[0]);
    option(sides[1][1], [["", "nobody"], ...named], state.sides[1] ?? there[1] ?? "");
    sides.forEach(([label, select], k) => { state.sides[k] = select.value; label.hidden = there.length < 2; });
    state.t = 0;
    cast();
  }

  function cast() {
    if (!state.episode) return;
    stages.forEach((stage, k) => { stage.root.hidden = !state.episode.flights[state.sides[k]]; });
    const times = decode(shown()[0].flight).times.values;
    state.period = times.length > 1 ? times[1] - times[0] : 0.1;
    slider.max = Math.round(duration() / state.period);
    for (const { side, stage, flight } of shown()) {
      const series = DATA.series[side], good = !flight.ending;
      stage.title.replaceChildren(swatch(series), series.label);
      stage.verdict.className = `verdict ${good ? "good" : "bad"}`;
      stage.verdict.replaceChildren(...(good ? [flight.text] : [el("strong", {}, flight.ending.label),
        ` after ${flight.ending.time.toFixed(1)} s; ${flight.text}`]));
      stage.warning.textContent = flight.error ? flight.error : "";
      if (flight.as_recorded === false) {
        stage.warning.append(" Flown again for this page it came out otherwise than in the table.");
      }
      stage.warning.hidden = !stage.warning.textContent;
      stage.canvas.setAttribute("aria-label", `${series.label}, seed ${state.episode.seed}: ${stage.verdict.textContent}`);
    }
    keys();
    seek(Math.min(state.t, duration()));
  }

  function keys() {
    const { scene } = state.episode, flights = shown().map(({ flight }) => decode(flight));
    if (!flights.some((one) => one.places)) return byId("scene-key").replaceChildren();
    const entry = (colour, text, dashes) => el("li", {}, svg("svg", { class: "swatch", viewBox: "0 0 26 11", "aria-hidden": "true" },
      svg("line", { x1: 0, x2: 26, y1: 5.5, y2: 5.5, stroke: colour, "stroke-width": 3, "stroke-dasharray": dashes || null })), text);
    const many = flights[0].places && flights[0].places.shape[1] > 1;
    const planned = scene.plan || flights.some((one) => one.plan);
    byId("scene-key").replaceChildren(...[
      many ? null : entry(INK.body, "body and its way"),
      entry(many ? INK.quiet : INK.goal, "goal", "4 3"),
      planned ? entry(INK.plan, "plan x_d", "2 4") : null,
      planned && flights.some((one) => one.measures.tube) ? entry(INK.tube, "published tube around the plan") : null,
      flights.some((one) => one.measures.proved) ? entry(INK.tube, "proved tube", "2 3") : null,
      flights.some((one) => one.push) ? entry(INK.push, "disturbance") : null,
      flights.some((one) => one.push && one.push.shape[2] === 4) ? entry(INK.rate, "disturbance of the rates") : null,
      many ? entry("#1a1a1a", "black rim: arrived") : null,
      entry(INK.bad, "failure")].filter(Boolean));
  }

  function draw() {
    const whole = duration();
    for (const { stage, flight } of shown()) {
      drawScene(stage.canvas, state.episode, flight, state.t);
      stage.timeAt = drawCurves(stage.curves, flight, state.t, whole);
      stage.numbers.textContent = numbers(flight);
    }
    slider.value = Math.round(state.t / state.period);
    slider.setAttribute("aria-valuetext", `${state.t.toFixed(1)} seconds`);
    clock.textContent = `${state.t.toFixed(1)} of ${whole.toFixed(1)} s`;
  }

  function numbers(flight) {
    const { times, measures, states } = decode(flight), at = (array) => entriesAt(array, times, state.t);
    const said = [`distance ${number(at(measures.distance)[0])}`];
    if (measures.error) said.push(`‖x − x_d‖ ${number(at(measures.error)[0])}`);
    if (states) at(states).forEach((value, k) => {
      const [, name, unit] = /^(.*?)(?: \[(.*)\])?$/.exec(DATA.states[k]);
      said.push(`${name} ${value.toFixed(2).replace(/^-(0\.00)$/, "$1").replace("-", "−")}${unit && unit !== "-" ? ` ${unit}` : ""}`);
    });
    return said.join(" · ");
  }

  function seek(t) {
    state.t = Math.min(Math.max(t, 0), duration());
    draw();
  }
  function step(count) { stop(); seek((Math.round(state.t / state.period) + count) * state.period); }
  function stop() { state.playing = false; play.textContent = "▶ Play"; }
  function toggle() {
    if (state.playing || !state.episode) return stop();
    if (state.t >= duration() - 1e-9) state.t = 0;
    state.playing = true;
    play.textContent = "❚❚ Stop";
    state.last = performance.now();
    requestAnimationFrame(turn);
  }
  function turn(now) {
    if (!state.playing) return;
    // A page in the background gets no frames; it does not jump when it is seen again.
    const passed = Math.min(Math.max(now - state.last, 0), 100) / 1e3;
    state.last = now;
    seek(state.t + passed * Number(speed.value));
    if (state.t >= duration() - 1e-9) stop(); else requestAnimationFrame(turn);
  }

  document.addEventListener("keydown", (event) => {
    const { target, key } = event, box = byId("stages").getBoundingClientRect();
    if (!state.episode || event.ctrlKey || event.metaKey || event.altKey) return;
    if (/^(INPUT|SELECT|BUTTON|TEXTAREA|A)$/.test(target.tagName) && !(target === slider && key === " ")) return;
    // Elsewhere on the page the keys scroll it, as everywhere.
    if (!byId("player").contains(target) && (box.bottom < 80 || box.top > window.innerHeight - 80)) return;
    const next = (by) => {
      const k = Math.min(Math.max(Number(episodes.value) + by, 0), state.episodes.length - 1);
      show(k);
    };
    const actions = { " ": toggle, ArrowLeft: () => step(event.shiftKey ? -10 : -1), ArrowRight: () => step(event.shiftKey ? 10 : 1),
      Home: () => { stop(); seek(0); }, End: () => { stop(); seek(duration()); }, n: () => next(1), p: () => next(-1) };
    const action = actions[key] || actions[key.toLowerCase()];
    if (!action) return;
    event.preventDefault();
    action();
  });
  let waiting = 0;
  window.addEventListener("resize", () => { cancelAnimationFrame(waiting); waiting = requestAnimationFrame(() => state.episode && draw()); });
  return choose;
}
