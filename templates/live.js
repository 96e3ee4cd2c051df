// Shows a session while it goes on: news come as server-sent events, plots are drawn on canvases.
(() => {
  'use strict';
  const WINDOW = 10; // s shown
  const COUNTERS = ['lines', 'lost', 'garbled', 'late', 'resets', 'stuck'];
  const $ = (id) => document.getElementById(id);
  const make = (tag, text = '', name = '') => {
    const element = document.createElement(tag);
    element.textContent = text;
    element.className = name;
    return element;
  };
  const time = (seconds) => {
    const s = Math.max(0, Math.round(seconds));
    return s < 60 ? `${s} s` : `${Math.floor(s / 60)} min ${s % 60} s`;
  };
  const short = (value) => (value === undefined ? '–' : value.toPrecision(3).replace('-', '−'));

  let state = { phase: 'waiting', waits: 'Waiting for the bench to answer.', turn: 0, offered: [], plan: [], remarks: [], units: {}, thought: { number: 0, text: '' }, carts: 0, seconds: 0, seconds_left: 0 };
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
    const rekeyed = fresh.carts !== state.carts || fresh.closed !== state.closed;
    state = fresh;
    document.title = `${state.now ?? 'At the bench'} – cartlab`;
    $('title').textContent = state.title || 'cartlab';
    tell(state.waits);
    showThought();
    for (const [id, unit] of [['positions', state.units.position], ['inputs', state.units.input]])
      $(id).closest('figure').querySelector('.unit').textContent = unit ? `in ${unit}` : '';
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
    if (rekeyed) listKeys();
    $('told').hidden = state.remarks.length === 0;
    $('remarks').replaceChildren(...state.remarks.map((text) => make('li', text)));
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
    const item = make('li', '', entry.state);
    item.append(make('span', word, 'state'), make('b', entry.id), make('span', entry.what, 'what'));
    if (entry.why) item.append(make('span', entry.why, 'why'));
    return item;
  };
  // What is recorded is folded, so that the run at hand and the next are in sight.
  const listPlan = () => {
    const done = state.plan.filter((entry) => entry.state === 'done');
    const left = state.plan.filter((entry) => entry.state !== 'done');
    const next = left.find((entry) => entry.state !== 'now');
    const items = left.map((entry) => listEntry(entry, entry === next ? `next${entry.why ? ', again' : ''}` : entry.state));
    if (done.length) {
      const fold = make('details');
      const list = make('ol');
      fold.open = $('plan').querySelector('details')?.open ?? false;
      list.append(...done.map((entry) => listEntry(entry)));
      fold.append(make('summary', `${done.length} recorded`), list);
      const item = make('li', '', 'fold');
      item.append(fold);
      items.unshift(item);
    }
    $('plan').replaceChildren(...items);
    const now = $('plan').querySelector('.now');
    if (now) $('plan').scrollTop = now.offsetTop - $('plan').clientHeight / 3;
  };
  const showCounters = (counters) => {
    const parts = COUNTERS.map((name) => {
      const part = make('div', '', name !== 'lines' && counters[name] ? 'bad' : '');
      part.append(make('dt', name), make('dd', String(counters[name])));
      return part;
    });
    const per = make('div');
    const [first, last] = [rate[0], rate.at(-1)];
    const known = rate.length > 1 && last[0] > first[0] + 500; // ms: less is chance
    per.append(make('dt', 'lines/s'), make('dd', known ? String(Math.round(1e3 * (last[1] - first[1]) / (last[0] - first[0]))) : '–'));
    document.querySelector('.counters').replaceChildren(per, ...parts);
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

  // What a plot draws: column of a point, name, colour, and where its strokes and gaps are told.
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
  const SVG = 'http://www.w3.org/2000/svg';
  const listKeys = () => {
    for (const id of ['positions', 'inputs']) {
      $(id).closest('figure').querySelector('.keys').replaceChildren(...series(id).map(({ name, colour, dash }) => {
        const item = make('li');
        const svg = document.createElementNS(SVG, 'svg');
        const line = document.createElementNS(SVG, 'line');
        for (const [key, value] of Object.entries({ x1: 0, x2: '100%', y1: '50%', y2: '50%', stroke: `var(${colour})` }))
          line.setAttribute(key, value);
        line.style.strokeDasharray = `var(${dash})`;
        svg.setAttribute('aria-hidden', 'true');
        svg.append(line);
        item.append(svg, make('span', name), ' ', make('span', '–', 'value'));
        return item;
      }));
    }
  };
  const ticks = (low, high, most) => {
    const rough = (high - low) / most;
    const power = 10 ** Math.floor(Math.log10(rough));
    const step = [1, 2, 5, 10].map((n) => n * power).find((n) => n >= rough);
    const found = [];
    for (let i = Math.ceil(low / step); i * step <= high; i += 1) found.push(i * step);
    return [found, Math.max(0, -Math.floor(Math.log10(step) + 1e-9))];
  };
  const draw = (id) => {
    const canvas = $(id);
    const { clientWidth: width, clientHeight: height } = canvas;
    const scale = window.devicePixelRatio || 1;
    if (canvas.width !== Math.round(width * scale) || canvas.height !== Math.round(height * scale)) {
      canvas.width = Math.round(width * scale);
      canvas.height = Math.round(height * scale);
    }
    const style = getComputedStyle(canvas);
    const colour = (name) => style.getPropertyValue(name);
    const pen = canvas.getContext('2d');
    pen.setTransform(scale, 0, 0, scale, 0, 0);
    pen.clearRect(0, 0, width, height);
    pen.font = `13px ${style.fontFamily}`;
    const box = { left: 58, right: width - 12, top: 8, bottom: height - 34 };
    const lines = series(id);

    const end = Math.max(WINDOW, points.at(-1)?.[0] ?? 0);
    const shown = points.filter((p) => p[0] >= end - WINDOW);
    const values = shown.flatMap((p) => lines.map((l) => p[l.column]));
    let [low, high] = [Math.min(0, ...values), Math.max(0, ...values)];
    if (high - low < 1e-9) [low, high] = [-1, 1];
    const margin = 0.06 * (high - low);
    [low, high] = [low - margin, high + margin];
    const x = (t) => box.left + ((t - end + WINDOW) / WINDOW) * (box.right - box.left);
    const y = (v) => box.bottom - ((v - low) / (high - low)) * (box.bottom - box.top);

    pen.lineWidth = 1;
    pen.strokeStyle = colour('--f-grid');
    pen.fillStyle = colour('--f-axis');
    const rule = (x1, y1, x2, y2) => { pen.beginPath(); pen.moveTo(x1, y1); pen.lineTo(x2, y2); pen.stroke(); };
    const [levels, digits] = ticks(low, high, height / 45);
    pen.textAlign = 'right';
    pen.textBaseline = 'middle';
    for (const level of levels) {
      rule(box.left, y(level), box.right, y(level));
      pen.fillText((Math.abs(level) < 1e-12 ? 0 : level).toFixed(digits).replace('-', '−'), box.left - 8, y(level));
    }
    pen.textAlign = 'center';
    pen.textBaseline = 'top';
    for (const t of ticks(end - WINDOW, end, width < 500 ? 5 : 10)[0]) {
      rule(x(t), box.top, x(t), box.bottom);
      if (x(t) < box.right - 30) pen.fillText(String(Math.round(t)), x(t), box.bottom + 6);
    }
    pen.textAlign = 'right';
    pen.fillText('t in s', box.right, box.bottom + 6);

    pen.save();
    pen.beginPath();
    pen.rect(box.left, box.top, box.right - box.left, box.bottom - box.top);
    pen.clip();
    pen.lineJoin = 'round';
    for (const line of lines) {
      pen.strokeStyle = colour(line.colour);
      pen.lineWidth = line.width ?? 2;
      pen.setLineDash(colour(line.dash).trim().split(' ').map(Number));
      pen.beginPath();
      shown.forEach((p, i) => (i ? pen.lineTo(x(p[0]), y(p[line.column])) : pen.moveTo(x(p[0]), y(p[line.column]))));
      pen.stroke();
    }
    pen.restore();
    const last = points.at(-1);
    const keys = canvas.closest('figure').querySelectorAll('.keys .value');
    lines.forEach((line, i) => { if (keys[i]) keys[i].textContent = short(last?.[line.column]); });
  };
  let drawn = 0;
  const frame = () => {
    drawn = 0;
    draw('positions');
    draw('inputs');
    showProgress();
  };
  const redraw = () => { drawn ||= requestAnimationFrame(frame); };

  // ------------------------------------------------------------------ news

  const news = new EventSource('events');
  news.addEventListener('state', (event) => {
    showState(JSON.parse(event.data));
    if (state.phase === 'over') news.close();
    redraw();
  });
  news.addEventListener('points', (event) => {
    const fresh = JSON.parse(event.data);
    if (fresh.run !== run) [run, points, rate] = [fresh.run, [], []];
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
  new ResizeObserver(redraw).observe($('positions'));
  matchMedia('(prefers-color-scheme: dark)').addEventListener('change', redraw);
  setInterval(showProgress, 250);
  showCounters(Object.fromEntries(COUNTERS.map((name) => [name, 0])));
  listKeys();
})();
