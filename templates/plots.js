// Lays runs over each other: measured, simulated, residuals, spectra. The form says what is shown, and the address keeps it.
(() => {
  'use strict';
  const { chart, keys, make, widened, written } = charts;
  const COLOURS = ['model', 'second', 'third', 'ink', 'fifth', 'sixth']; // of several runs
  const LOOKS = { // of one run; the kind of line tells models apart in any case
    measured: { colour: 'ink', dash: [2, 2] }, linear: { colour: 'second', dash: [7, 4] },
    effects: { colour: 'model', dash: [] }, loop: { colour: 'third', dash: [8, 3, 2, 3] },
  };
  const TITLES = { overlay: 'position', residual: 'residual', spectrum: 'amplitude', leftover: 'residual amplitude' };
  const SUBSCRIPT = '₀₁₂₃₄₅₆₇₈₉';
  const $ = (id) => document.getElementById(id);
  const data = JSON.parse($('data').textContent);
  const form = $('choose'), panels = $('panels'), told = $('told');

  // ---------------------------------------------------------------- numbers

  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;
  const unpack = ([middle, step, text]) => {
    const view = new DataView(bytes(text));
    return Array.from({ length: view.byteLength / 2 }, (_, i) => {
      const level = view.getInt16(2 * i, true);
      return level === -32768 ? null : middle + step * level;
    });
  };
  const times = (text, n) => {
    if (!text.includes(' ')) {
      const view = new DataView(bytes(text));
      return Array.from({ length: view.byteLength / 4 }, (_, i) => view.getFloat32(4 * i, true));
    }
    const [first, last] = text.split(' ').map(Number);
    return Array.from({ length: n }, (_, i) => first + ((last - first) * i) / (n - 1));
  };
  const powers = (packed) => unpack(packed).map((v) => (v === null ? null : 10 ** v));
  const share = (v) => `${Number((100 * v).toPrecision(v >= 0.0995 ? 3 : 2))} %`;
  const less = (a, b) => a.map((v, i) => (v === null || b[i] === null ? null : v - b[i]));
  const within = (v, low, high) => Math.min(Math.max(v, low), high);

  const opened = new Map(); // each run is unpacked once
  const open = (id) => {
    if (!opened.has(id)) {
      const run = data.runs.find((one) => one.id === id);
      const carts = run.carts.map((cart) => {
        const y = unpack(cart.y);
        const models = cart.models.map((one) => {
          const residual = unpack(one.residual);
          return {
            line: one.model, nrmse: one.nrmse, residual, overlay: less(y, residual),
            spectrum: powers(one.spectrum), leftover: powers(one.residual_spectrum),
          };
        });
        return [cart.cart, [{ line: 'measured', overlay: y, spectrum: powers(cart.spectrum) }, ...models]];
      });
      const u = run.u && unpack(run.u);
      const n = carts.length ? carts[0][1][0].overlay.length : u ? u.length : 0;
      opened.set(id, { id, note: run.note, t: times(run.t, n), u, omega: unpack(run.omega), carts: new Map(carts) });
    }
    return opened.get(id);
  };

  // ---------------------------------------------------------------- what is shown

  const boxes = (name) => [...form.querySelectorAll(`[name="${name}"]`)];
  const chosen = (name) => boxes(name).filter((box) => box.checked).map((box) => box.value);
  const first = () => (boxes('run').find((box) => data.runs.some((r) => r.id === box.value && r.kind === 'step')) ?? boxes('run')[0])?.value;

  function readAddress() {
    const asked = new URLSearchParams(location.hash.slice(1));
    const known = asked.getAll('run').filter((id) => boxes('run').some((box) => box.value === id));
    const runs = known.length ? known : [first()];
    for (const box of boxes('run')) box.checked = runs.includes(box.value);
    for (const name of ['cart', 'line'])
      for (const box of boxes(name)) box.checked = !asked.has(name) || asked.getAll(name).includes(box.value);
    const show = asked.get('show') ?? 'overlay';
    for (const box of boxes('show')) box.checked = box.value === show;
    if (!chosen('show').length) boxes('show')[0].checked = true;
    for (const box of boxes('input')) box.checked = asked.has('input');
    for (const box of boxes('run')) if (box.checked) box.closest('details').open = true;
    return known.length > 0;
  }

  function writeAddress() {
    const kept = new URLSearchParams(chosen('run').map((id) => ['run', id]));
    for (const name of ['cart', 'line'])
      if (chosen(name).length < boxes(name).length) for (const value of chosen(name)) kept.append(name, value);
    const [show] = chosen('show');
    if (show !== 'overlay') kept.append('show', show);
    if (chosen('input').length) kept.append('input', '1');
    try {
      history.replaceState(null, '', `#${kept}`);
    } catch { /* a page without an address of its own keeps none */ }
  }

  // ---------------------------------------------------------------- plots

  let drawn = [];
  const stageOf = (plot) => plot.root.parentElement;

  function curves(runs, cart, show) {
    const lines = chosen('line'), several = runs.length > 1;
    return runs.flatMap((run, k) => (run.carts.get(cart) ?? [])
      .filter((one) => lines.includes(one.line) && one[show])
      .map((one) => {
        const look = LOOKS[one.line];
        return {
          x: show === 'overlay' || show === 'residual' ? run.t : run.omega, y: one[show],
          name: `${several ? `${run.id}: ` : ''}${data.names[one.line]}`, told: one.nrmse === undefined ? undefined : share(one.nrmse),
          colour: `--f-${several ? COLOURS[k % COLOURS.length] : look.colour}`, dash: look.dash,
          points: one.line === 'measured' && show === 'overlay', measured: one.line === 'measured',
        };
      }));
  }

  function panel(name, list, { unit, show, last }) {
    const spectral = show === 'spectrum' || show === 'leftover';
    const measured = list.filter((one) => one.measured).flatMap((one) => one.y.filter((v) => v !== null));
    const low = measured.reduce((a, b) => Math.min(a, b), Infinity);
    const high = measured.reduce((a, b) => Math.max(a, b), -Infinity);
    const insight = (u, min, max) => { // a model that runs away does not hide what was measured
      if (min === null || max === null) return [0, 1];
      if (spectral) return uPlot.rangeLog(Math.max(min, max * 1e-5), max, 10, true);
      const span = high - low || 1;
      return measured.length ? widened(Math.max(min, low - span), Math.min(max, high + span)) : widened(min, max);
    };
    const stage = make('div', {
      class: name === 'u' ? 'stage input' : 'stage', tabindex: 0, role: 'group',
      'aria-label': `${name}, ${TITLES[show]}: arrow keys read values, plus and minus zoom, 0 shows all`,
    });
    const values = make('output');
    const button = (text, title, action) => {
      const node = make('button', { type: 'button', title, 'aria-label': `${title}: ${name}` }, text);
      node.addEventListener('click', action);
      return node;
    };
    const tools = make('div', { class: 'tools' },
      button('+', 'Zoom in', () => scale(0.5)), button('−', 'Zoom out', () => scale(2)), button('All', 'Show all', () => all()),
      make('span', { class: 'hint' }, 'Point for values, drag to zoom.'), values);
    panels.append(make('div', { class: 'panel' }, stage, make('ul', { class: 'key' }, ...keys(list)), tools));
    const distr = spectral ? 3 : 1;
    const plot = chart(stage, uPlot.join(list.map((one) => [one.x, one.y])), list, {
      across: last ? (spectral ? 'frequency [rad/s]' : 'time [s]') : undefined, up: `${name} [${unit}]`,
      x: { distr, range: (u, min, max) => (min === null ? [1, 10] : [min, max]) }, y: { distr, range: insight },
      cursor: { sync: { key: 'runs' }, y: false, drag: { x: true, y: false } },
      hooks: {
        setCursor: [(u) => values.replaceChildren(...read(u, list, spectral))],
        setScale: [(u, which) => { if (which === 'x') link(u); }],
      },
    });
    drawn.push(plot);

    const move = (step) => {
      const xs = plot.data[0], { min, max } = plot.scales.x;
      const from = xs.findIndex((x) => x >= min), to = xs.findLastIndex((x) => x <= max);
      const at = within((plot.cursor.idx ?? (step > 0 ? from - 1 : to + 1)) + step, from, to);
      plot.setCursor({ left: plot.valToPos(xs[at], 'x'), top: plot.over.clientHeight / 2 });
    };
    const scale = (factor) => {
      const { min, max } = plot.scales.x, { left } = plot.cursor;
      const place = (x) => (spectral ? Math.log(x) : x), back = (x) => (spectral ? Math.exp(x) : x);
      const [a, b] = [place(min), place(max)];
      const middle = left >= 0 ? place(plot.posToVal(left, 'x')) : (a + b) / 2;
      const xs = plot.data[0];
      plot.setScale('x', {
        min: Math.max(back(middle + (a - middle) * factor), xs[0]),
        max: Math.min(back(middle + (b - middle) * factor), xs[xs.length - 1]),
      });
    };
    const all = () => plot.setScale('x', { min: plot.data[0][0], max: plot.data[0][plot.data[0].length - 1] });
    stage.addEventListener('keydown', (event) => {
      const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      if (step) move(step);
      else if (event.key === '+' || event.key === '=') scale(0.5);
      else if (event.key === '-') scale(2);
      else if (event.key === '0' || event.key === 'Escape') all();
      else return;
      event.preventDefault();
    });
  }

  function read(u, list, spectral) { // of each line, its sample nearest to the cursor
    if (u.cursor.idx == null) return [];
    const x = u.data[0][u.cursor.idx];
    const found = list.map((one, k) => {
      const y = u.data[k + 1];
      for (let away = 0; away < y.length; away++)
        for (const i of [u.cursor.idx - away, u.cursor.idx + away]) {
          if (y[i] === null) return null;
          if (y[i] !== undefined) return `${one.name} ${written(y[i])}`;
        }
      return null;
    });
    return [make('b', {}, `${written(x)} ${spectral ? 'rad/s' : 's'}`), ` ${found.filter(Boolean).join(', ')}`];
  }

  let linking = true;
  function link(from) { // plots below each other show one stretch
    if (linking) return;
    linking = true;
    const { min, max } = from.scales.x;
    for (const plot of drawn) if (plot !== from) plot.setScale('x', { min, max });
    linking = false;
  }

  function draw() {
    const held = drawn.findIndex((plot) => stageOf(plot) === document.activeElement);
    linking = true;
    for (const plot of drawn) plot.destroy();
    drawn = [];
    panels.replaceChildren();
    const runs = chosen('run').map(open), [show] = chosen('show');
    const timed = show === 'overlay' || show === 'residual';
    const wanted = chosen('cart').map(Number).map((cart) => [`x${SUBSCRIPT[cart]}`, curves(runs, cart, show), data.units.position])
      .filter(([, list]) => list.length);
    const pushed = runs.filter((run) => run.u).map((run, k) => ({
      x: run.t, y: run.u, name: runs.length > 1 ? `${run.id}: u` : 'u', dash: [],
      colour: `--f-${runs.length > 1 ? COLOURS[k % COLOURS.length] : 'ink'}`,
    }));
    if (chosen('input').length && timed && pushed.length) wanted.push(['u', pushed, data.units.input]);
    told.textContent = wanted.length
      ? `${runs.map((run) => run.id).join(', ')}: ${TITLES[show]}`
      : 'Nothing to show: choose a run, a cart and a line.';
    panels.classList.toggle('several', wanted.length > 1);
    wanted.forEach(([name, list, unit], i) => panel(name, list, { unit, show, last: i === wanted.length - 1 }));
    $('notes').replaceChildren(...runs.filter((run) => run.note)
      .map((run) => make('p', { class: 'small' }, make('b', {}, run.id), `: ${run.note}.`)));
    linking = false;
    if (drawn[held]) stageOf(drawn[held]).focus({ preventScroll: true });
  }

  // ---------------------------------------------------------------- at work

  $('still')?.remove();
  form.hidden = false;
  $('shown').hidden = false;
  readAddress();
  draw();
  form.addEventListener('change', () => {
    writeAddress();
    draw();
  });
  form.addEventListener('submit', (event) => event.preventDefault());
  addEventListener('hashchange', () => {
    if (!new URLSearchParams(location.hash.slice(1)).has('run')) return; // a place on this page
    readAddress();
    draw();
    $('plot').scrollIntoView();
    panels.querySelector('.stage')?.focus({ preventScroll: true });
  });
})();
