// Shows a session while it goes on: news come as server-sent events.
(() => {
  'use strict';
  const { chart, keys, make, widened } = charts;
  const WINDOW = 10; // s shown
  const COUNTERS = ['lines', 'lost', 'garbled', 'late', 'resets', 'stuck'];
  const $ = (id) => document.getElementById(id);
  const time = (seconds) => {
    const s = Math.max(0, Math.round(seconds));
    return s < 60 ? `${s} s` : `${Math.floor(s / 60)} min ${s % 60} s`;
  };
  const short = (value) => (value === undefined ? '–' : value.toPrecision(3).replace('-', '−'));

  let state = { phase: 'waiting', waits: 'Waiting for the bench to answer.', turn: 0, offered: [], plan: [], remarks: [], units: {}, springs: [], free: [], thought: { number: 0, text: '' }, carts: 0, seconds: 0, seconds_left: 0 };
  let since = performance.now(); // when the phase began
  let run = 0;
  let points = []; // [t, input, target, x1, …] of this run
  let rate = [];

  // ------------------------------------------------------------------ words and lists

  const tell = (text, lost = false) => {
    if ($('status').textContent !== text) $('status').textContent = text;
    $('status').classList.toggle('lost', lost);
  };
  const showState = (fresh) => {
    if (fresh.phase !== state.phase || fresh.now !== state.now) since = performance.now();
    const asked = fresh.instruction?.number !== state.instruction?.number;
    const relisted = JSON.stringify(fresh.plan) !== JSON.stringify(state.plan);
    const redrawn = ['carts', 'closed', 'units', 'springs', 'free'].some((name) => JSON.stringify(fresh[name]) !== JSON.stringify(state[name]));
    state = fresh;
    document.title = `${state.now ?? 'At the bench'} – cartlab`;
    $('title').textContent = state.title || 'cartlab';
    tell(state.waits);
    showThought();
    // Asked whether to record again, the answer is one of the buttons that are offered.
    const again = state.offered.includes('repeat');
    for (const button of document.querySelectorAll('[data-wish]'))
      if (button.id !== 'stop') button.disabled = !state.offered.includes(button.dataset.wish);
    if (state.phase === 'over') showEnd();
    $('confirm').hidden = again;
    if (asked) {
      $('ask').hidden = !state.instruction;
      $('instruction').textContent = state.instruction?.text ?? '';
      $('confirm').disabled = false;
      if (state.instruction) $(again ? 'repeat' : 'confirm').focus({ preventScroll: true });
    }
    if (relisted) listPlan();
    if (redrawn) { makePlots(); makeBench(); }
    $('told').hidden = state.remarks.length === 0;
    $('remarks').replaceChildren(...state.remarks.map((text) => make('li', {}, text)));
  };
  // Nothing can be pressed any more; at the desk, links lead to what came of it.
  const showEnd = () => {
    for (const button of document.querySelectorAll('[data-wish]')) {
      button.disabled = true;
      button.hidden = button.id !== 'stop';
    }
    $('stop').textContent = 'Session over';
    document.querySelector('.controls').append(...($('after')?.children ?? []));
  };
  // Of an exploration: why it records what it records, and its diary, which the desk shows below.
  let thoughts = 0;
  const showThought = () => {
    const { number, text } = state.thought;
    if (number === thoughts) return;
    thoughts = number;
    $('thought').hidden = false;
    $('thought').textContent = `${text.replace(/^[a-z]/, (first) => first.toUpperCase())}.`;
    for (const whole of document.querySelectorAll('#whole, [for="whole"]')) whole.hidden = true; // nobody knows how long it takes
    $('skip').textContent = 'Veto';
    $('skip').title = 'Do not record this one: choose another';
    const diary = $('diary');
    if (!diary) return;
    diary.closest('section').hidden = false;
    diary.src = `${diary.dataset.page}?${number}#errors`;
  };
  const listEntry = (entry, word = entry.state) => {
    const parts = { state: word, what: entry.what, ...(entry.why && { why: entry.why }) };
    const [state, ...rest] = Object.entries(parts).map(([name, text]) => make('span', { class: name }, text));
    return make('li', { class: entry.state }, state, make('b', {}, entry.id), ...rest);
  };
  // What is recorded is folded, so that the run at hand and the next are in sight.
  const listPlan = () => {
    const done = state.plan.filter((entry) => entry.state === 'done');
    const left = state.plan.filter((entry) => entry.state !== 'done');
    const next = left.find((entry) => entry.state !== 'now');
    const items = left.map((entry) => listEntry(entry, entry === next ? `next${entry.why ? ', again' : ''}` : entry.state));
    if (done.length) {
      const fold = make('details', {}, make('summary', {}, `${done.length} recorded`), make('ol', {}, ...done.map((entry) => listEntry(entry))));
      fold.open = $('plan').querySelector('details')?.open ?? false;
      items.unshift(make('li', { class: 'fold' }, fold));
    }
    $('plan').replaceChildren(...items);
    const now = $('plan').querySelector('.now');
    if (now) $('plan').scrollTop = now.offsetTop - $('plan').clientHeight / 3;
  };
  const showCounters = (counters) => {
    const part = (name, text, bad) => make('div', { class: bad ? 'bad' : '' }, make('dt', {}, name), make('dd', {}, text));
    const [first, last] = [rate[0], rate.at(-1)];
    const known = rate.length > 1 && last[0] > first[0] + 500; // ms: less is chance
    const per = known ? String(Math.round(1e3 * (last[1] - first[1]) / (last[0] - first[0]))) : '–';
    const parts = COUNTERS.map((name) => part(name, String(counters[name]), name !== 'lines' && counters[name]));
    document.querySelector('.counters').replaceChildren(part('lines/s', per), ...parts);
  };
  const showProgress = () => {
    const spent = (performance.now() - since) / 1e3;
    let done = 0; // s of this recording
    if (state.phase === 'settling') done = Math.min(spent, state.settle);
    if (state.phase === 'recording') done = state.settle + (points.at(-1)?.[0] ?? 0);
    const left = Math.max(0, state.seconds_left - done);
    $('whole').max = $('part').max = 1;
    $('whole').value = state.seconds ? 1 - left / state.seconds : 0;
    $('left').textContent = state.seconds ? `${time(left)} left` : '';
    const total = state.settle + state.duration;
    $('part').value = state.now ? Math.min(1, done / total) : 0;
    $('elapsed').textContent = state.now ? `${time(total - done)} left` : '';
  };

  // ------------------------------------------------------------------ plots

  // What a plot draws: column of a point, name, colour, strokes and gaps.
  const series = (id) => {
    const target = { column: 2, name: 'target', colour: '--f-axis', dash: '--target-dash', width: 1.5 };
    if (id === 'inputs') {
      const input = { column: 1, name: 'input', colour: '--f-model', dash: '--cart-1-dash' };
      return state.closed ? [input] : [target, input];
    }
    const carts = Array.from({ length: state.carts }, (_, i) => (
      { column: 3 + i, name: `cart ${i + 1}`, colour: `--cart-${i + 1}`, dash: `--cart-${i + 1}-dash` }));
    return state.closed ? [target, ...carts] : carts;
  };
  const plots = new Map(); // of each place: the plot, its lines, and the values in its key
  const makePlots = () => {
    for (const [id, name, unit] of [['positions', 'position', state.units.position], ['inputs', 'input', state.units.input]]) {
      const list = $(id).closest('figure').querySelector('.keys'), lines = series(id);
      list.replaceChildren(...keys(lines.map((line) => ({ ...line, told: '–' }))));
      plots.get(id)?.plot.destroy();
      const plot = chart($(id), columns(lines), lines, {
        across: 'time [s]', up: unit ? `${name} [${unit}]` : name, cursor: { show: false },
        x: { range: () => [end() - WINDOW, end()] },
        y: { range: (u, min, max) => widened(Math.min(0, min), Math.max(0, max)) },
      });
      plots.set(id, { plot, lines, told: [...list.querySelectorAll('b')] });
    }
  };
  const end = () => Math.max(WINDOW, points.at(-1)?.[0] ?? 0);
  const columns = (lines) => [0, ...lines.map((line) => line.column)].map((column) => points.map((p) => p[column]));
  let drawn = 0;
  const frame = () => {
    drawn = 0;
    for (const { plot, lines, told } of plots.values()) {
      plot.setData(columns(lines));
      lines.forEach((line, i) => { told[i].textContent = short(points.at(-1)?.[line.column]); });
    }
    moveCarts();
    showProgress();
  };
  const redraw = () => { drawn ||= requestAnimationFrame(frame); };

  // ------------------------------------------------------------------ the carts

  const CART = 70, GAP = 110, MOST = 50, AXLE = 58; // px: width, rest distance, largest motion, height of the springs
  let bench = null; // what moves: the carts, the springs, the arrow of the input
  let largest = { input: 0, motion: 0 }; // of this run
  const restOf = (i) => (i < 0 ? 0 : i < state.carts ? GAP + i * (CART + GAP) : GAP + state.carts * (CART + GAP));
  const coil = (from, to) => {
    const [ends, turns] = [10, 8], pitch = (to - from - 2 * ends) / turns;
    const bends = Array.from({ length: turns }, (_, i) => `L${(from + ends + (i + 0.5) * pitch).toFixed(1)} ${AXLE + (i % 2 ? 9 : -9)}`);
    return `M${from.toFixed(1)} ${AXLE}H${(from + ends).toFixed(1)}${bends.join('')}L${(to - ends).toFixed(1)} ${AXLE}H${to.toFixed(1)}`;
  };
  const makeBench = () => {
    bench = null;
    if (!state.carts) return $('carts').replaceChildren();
    const width = restOf(state.carts), wall = (x) => make('line', { class: 'wall', x1: x, x2: x, y1: 20, y2: 90 });
    const carts = Array.from({ length: state.carts }, (_, i) => make('g', { class: state.free.includes(i + 1) || !state.now ? '' : 'held' },
      make('rect', { x: 0, y: 34, width: CART, height: 46, rx: 6, stroke: `var(--cart-${i + 1})` }),
      make('circle', { cx: 16, cy: 84, r: 6 }), make('circle', { cx: CART - 16, cy: 84, r: 6 }),
      make('text', { x: CART / 2, y: 63 }, state.free.includes(i + 1) || !state.now ? String(i + 1) : `${i + 1} held`)));
    const springs = state.springs.map((there) => there && make('path', { class: 'spring' }));
    const force = make('path', { class: 'force' });
    const walls = [state.springs[0] && wall(0), state.springs.at(-1) && wall(width)].filter(Boolean);
    const floor = make('line', { class: 'wall', x1: 0, x2: width, y1: 90, y2: 90 });
    $('carts').replaceChildren(make('svg', { viewBox: `-4 0 ${width + 8} 94` }, floor, ...walls, ...springs.filter(Boolean), ...carts, force));
    bench = { carts, springs, force };
    moveCarts();
  };
  const moveCarts = () => {
    if (!bench) return;
    const [, input = 0, , ...x] = points.at(-1) ?? [];
    const scale = largest.motion ? MOST / largest.motion : 0;
    const at = bench.carts.map((_, i) => restOf(i) + scale * (x[i] ?? 0));
    bench.carts.forEach((cart, i) => cart.setAttribute('transform', `translate(${at[i].toFixed(1)} 0)`));
    bench.springs.forEach((spring, j) => spring && spring.setAttribute('d', coil(j ? at[j - 1] + CART : 0, at[j] ?? restOf(j))));
    const [from, long] = [at[0] + CART / 2, largest.input ? 45 * input / largest.input : 0];
    bench.force.setAttribute('d', Math.abs(long) < 1 ? '' : `M${from} 20h${long}m${-6 * Math.sign(long)} -5l${6 * Math.sign(long)} 5l${-6 * Math.sign(long)} 5`);
  };
  const measure = (fresh) => {
    for (const [, input, , ...x] of fresh) {
      largest.input = Math.max(largest.input, Math.abs(input));
      largest.motion = Math.max(largest.motion, ...x.map(Math.abs));
    }
  };

  // ------------------------------------------------------------------ news

  const news = new EventSource('events');
  news.addEventListener('state', (event) => {
    showState(JSON.parse(event.data));
    if (state.phase === 'over') news.close();
    redraw();
  });
  news.addEventListener('points', (event) => {
    const fresh = JSON.parse(event.data);
    if (fresh.run !== run) [run, points, rate, largest] = [fresh.run, [], [], { input: 0, motion: 0 }];
    measure(fresh.points);
    points.push(...fresh.points);
    while (points.length && points[0][0] < points.at(-1)[0] - WINDOW) points.shift();
    rate.push([performance.now(), fresh.counters.lines]);
    while (rate.length > 2 && rate[0][0] < rate.at(-1)[0] - 2000) rate.shift();
    showCounters(fresh.counters);
    redraw();
  });
  news.addEventListener('ended', () => location.reload());  // at the desk: the page came too late to watch
  news.addEventListener('error', () => {
    const refused = news.readyState === EventSource.CLOSED;
    tell(refused ? 'Too many pages show this session: close one of them, then reload this page.' : 'The connection is lost; trying again …', true);
  });
  news.addEventListener('open', () => tell(state.waits));
  const press = async (wish, number) => {
    try {
      const answer = await fetch('press', { method: 'POST', body: new URLSearchParams({ wish, number }) });
      if (answer.status >= 500) throw new Error(answer.statusText);
    } catch {
      tell(`No answer to ${wish}. Use Ctrl-C in the terminal, or the switch of the bench.`, true);
    }
  };
  $('confirm').addEventListener('click', async () => {
    $('confirm').disabled = true;
    await press('done', state.instruction?.number);
    $('confirm').disabled = false;
  });
  for (const button of document.querySelectorAll('[data-wish]'))
    button.addEventListener('click', () => press(button.dataset.wish, state.turn));
  document.addEventListener('keydown', (event) => {
    if (event.key === 'Escape' && state.phase !== 'over') press('stop', state.turn);
  });
  setInterval(showProgress, 250);
  showCounters(Object.fromEntries(COUNTERS.map((name) => [name, 0])));
  makePlots();
})();
