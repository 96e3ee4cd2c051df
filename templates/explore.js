// Figures that a reader explores: values under the pointer, zoom by dragging, keys and buttons.
// The drawing stays what it is; zooming maps its positions, and draws series anew from all their
// data, which the drawing carries as base64 of float32 ("first last" for evenly spaced numbers).
(() => {
  'use strict';
  const NS = 'http://www.w3.org/2000/svg';
  const PAIR = /(-?[\d.]+(?:e[-+]?\d+)?)[\s,]+(-?[\d.]+(?:e[-+]?\d+)?)/g;
  const DRAGGED = 5; // points: a shorter drag is a click
  const STEPS = 60; // arrow keys across a panel that has no points
  const CLOSEST = 1e-4; // of a panel: further in, the numbers have no more digits

  const make = (tag, attributes, ...children) => {
    const drawn = ['g', 'path', 'circle', 'rect'].includes(tag);
    const node = drawn ? document.createElementNS(NS, tag) : document.createElement(tag);
    for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
    node.append(...children);
    return node;
  };
  const unpack = (text) =>
    new Float32Array(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer);
  const spread = (text, n) => {
    if (!text.includes(' ')) return unpack(text);
    const [first, last] = text.split(' ').map(Number);
    return Float64Array.from({ length: n }, (_, i) => first + ((last - first) * i) / (n - 1));
  };
  const written = (v, digits = 4) =>
    Number.isFinite(v) ? String(Number(v.toPrecision(digits))).replace(/-/g, '−') : '–';
  const within = (v, low, high) => Math.min(Math.max(v, low), high);

  function roundTicks(low, high, most) {
    const magnitude = 10 ** Math.floor(Math.log10((high - low) / most));
    const step = [1, 2, 5, 10].map((f) => f * magnitude).find((s) => (high - low) / s <= most);
    const first = Math.ceil(low / step - 1e-9);
    const count = Math.floor(high / step + 1e-9) - first + 1;
    return Array.from({ length: Math.max(count, 0) }, (_, i) => Number(((first + i) * step).toPrecision(12)));
  }

  class Axis {
    constructor([low, high], log, start, length) {
      Object.assign(this, { log, start, length, view: [0, 1] });
      [this.low, this.high] = log ? [Math.log(low), Math.log(high)] : [low, high];
    }
    share(value) { return ((this.log ? Math.log(value) : value) - this.low) / (this.high - this.low); }
    value(share) {
      const v = this.low + share * (this.high - this.low);
      return this.log ? Math.exp(v) : v;
    }
    at(share) { return this.start + (this.length * (share - this.view[0])) / (this.view[1] - this.view[0]); }
    under(place) { return this.view[0] + ((place - this.start) / this.length) * (this.view[1] - this.view[0]); }
    moved(place) { return this.at((place - this.start) / this.length); }
    place(value) { return this.at(this.share(value)); }
    holds(place) { return (place - this.start) * (place - this.start - this.length) <= 0; }
    zoom(a, b) {
      const [low, high] = [Math.min(a, b), Math.max(a, b)];
      const size = within(high - low, CLOSEST, 1);
      const first = within(low, 0, 1 - size);
      this.view = [first, first + size];
    }
    ticks(most) {
      const [low, high] = this.view.map((s) => this.value(s));
      if (this.log && high / low > 7) {
        const exponents = Array.from({ length: 40 }, (_, i) => i - 20);
        const all = exponents.flatMap((e) => [1, 2, 5].map((f) => f * 10 ** e));
        return all.filter((t) => t >= low && t <= high);
      }
      return roundTicks(low, high, most);
    }
  }

  class Series {
    constructor(group) {
      this.name = group.dataset.name;
      this.y = unpack(group.dataset.y);
      this.x = spread(group.dataset.x, this.y.length);
      this.path = group.querySelector('path[clip-path]');
      this.marked = Boolean(group.querySelector('use')) && !this.path;
      this.dotted = this.path?.style.strokeLinecap === 'round';
      this.ordered = this.x.every((v, i) => i === 0 || v >= this.x[i - 1]);
      this.points = this.marked || this.dotted;
      this.drawn = this.path?.getAttribute('d');
    }
    redraw({ x, y }) {
      const places = Array.from(this.x, (v, i) => [x.place(v), y.place(this.y[i])])
        .filter(([a, b]) => Number.isFinite(a) && Number.isFinite(b))
        .map(([a, b]) => `${a.toFixed(2)} ${b.toFixed(2)}`);
      this.path.setAttribute('d', this.dotted ? places.map((p) => `M${p}h.01`).join('') : `M${places.join('L')}`);
    }
    nearest(panel, at) { // by x alone where x ascends, else by distance
      let [best, least] = [-1, Infinity];
      for (let i = 0; i < this.x.length; i++) {
        const across = panel.x.place(this.x[i]) - at.x;
        const up = this.ordered ? 0 : panel.y.place(this.y[i]) - at.y;
        const apart = across * across + up * up;
        if (apart < least) [best, least] = [i, apart];
      }
      return best;
    }
    read(panel, at, value) { // [x, y] at an abscissa; lines are interpolated
      const i = this.nearest(panel, at);
      if (this.points || !this.ordered) return [this.x[i], this.y[i]];
      const j = within(this.x[i] < value ? i + 1 : i - 1, 0, this.x.length - 1);
      const gap = this.x[j] - this.x[i];
      const beyond = (value - this.x[0]) * (value - this.x[this.x.length - 1]) > 0;
      if (beyond) return [value, NaN];
      return [value, gap ? this.y[i] + ((value - this.x[i]) / gap) * (this.y[j] - this.y[i]) : this.y[i]];
    }
  }

  class Panel {
    constructor(group) {
      const { box: [left, top, width, height], x, y, log, titles } = JSON.parse(group.dataset.panel);
      this.group = group;
      this.x = new Axis(x, log[0], left, width);
      this.y = new Axis(y, log[1], top + height, -height);
      this.title = titles[2];
      [this.across, this.up] = titles.slice(0, 2).map((t) => {
        const [, name, unit] = t.match(/^(.*?)(?: \[(.*)\])?$/s);
        return { name, unit: (unit ?? '').replace(/^dB re.*/, 'dB') };
      });
      this.link = [titles[0], x].join();
      this.column = [this.link, left].join();
      this.series = [...group.querySelectorAll('[data-x]')].map((g) => new Series(g))
        .sort((a, b) => b.points - a.points); // first what was measured
      const owned = new Set(this.series.filter((s) => !s.marked).map((s) => s.path));
      this.paths = [...group.querySelectorAll('path[clip-path], [clip-path] path')]
        .filter((p) => !owned.has(p) && !p.closest('.grid-x, .grid-y, defs'))
        .map((node) => [node, node.getAttribute('d')]);
      this.uses = [...group.querySelectorAll('[clip-path] use')]
        .map((node) => [node, node.getAttribute('x'), node.getAttribute('y')]);
      this.marks = [...group.querySelectorAll('.mark text')].map((node) => [node, node.getAttribute('x'), node.getAttribute('transform')]);
      this.labels = { x: [...group.querySelectorAll('.tick-x')], y: [...group.querySelectorAll('.tick-y')] };
      this.grids = ['x', 'y'].map((k) => group.querySelector(`.grid-${k} path`));
      this.drawnGrids = this.grids.map((g) => g?.getAttribute('d'));
      this.own = make('g', {});
      group.append(this.own);
    }
    get whole() { return [...this.x.view, ...this.y.view].join() === '0,1,0,1'; }
    redraw() {
      const { x, y, whole } = this;
      for (const [node, d] of this.paths)
        node.setAttribute('d', whole ? d : d.replace(PAIR, (_, a, b) => `${x.moved(+a).toFixed(2)} ${y.moved(+b).toFixed(2)}`));
      for (const [node, a, b] of this.uses) {
        node.setAttribute('x', whole ? a : x.moved(+a));
        node.setAttribute('y', whole ? b : y.moved(+b));
      }
      for (const [node, a, turned] of this.marks) {
        const place = x.moved(+a);
        node.setAttribute('x', whole ? a : place);
        if (whole && turned) node.setAttribute('transform', turned);
        else node.removeAttribute('transform');
        node.style.display = x.holds(place) ? '' : 'none';
      }
      for (const series of this.series)
        if (series.path && whole) series.path.setAttribute('d', series.drawn);
        else if (series.path) series.redraw(this);
      this.own.replaceChildren();
      for (const texts of Object.values(this.labels)) for (const t of texts) t.style.display = whole ? '' : 'none';
      this.grids.forEach((grid, k) => grid?.setAttribute('d', whole ? this.drawnGrids[k] : ''));
      if (!whole) this.drawTicks();
    }
    drawTicks() {
      const ends = [this.y.start, this.y.start + this.y.length];
      const sides = [this.x.start, this.x.start + this.x.length];
      const xs = this.x.ticks(6), ys = this.y.ticks(5);
      this.grids[0]?.setAttribute('d', xs.map((t) => `M${this.x.place(t)} ${ends[0]}V${ends[1]}`).join(''));
      this.grids[1]?.setAttribute('d', ys.map((t) => `M${sides[0]} ${this.y.place(t)}H${sides[1]}`).join(''));
      const label = (t, model, name, place) => {
        const text = model.querySelector('text').cloneNode();
        text.removeAttribute('transform');
        text.setAttribute(name, place);
        text.textContent = written(t, 6);
        this.own.append(text);
        return text;
      };
      if (this.labels.x.length) for (const t of xs) label(t, this.labels.x[0], 'x', this.x.place(t));
      const model = this.labels.y[0];
      if (!model) return;
      // What a label's baseline lies below its tick by is the same for all.
      const first = this.drawnGrids[1].match(PAIR)[0].split(/[\s,]+/)[1];
      const drop = +model.querySelector('text').getAttribute('y') - first;
      for (const t of ys) label(t, model, 'y', this.y.place(t) + drop);
    }
  }

  function explore(figure) {
    const svg = figure.querySelector('svg');
    const panels = [...svg.querySelectorAll('.panel')].map((g) => new Panel(g));
    if (!panels.some((panel) => panel.series.length)) return;
    const linked = (panel) => panels.filter((p) => p.link === panel.link); // zoom together
    const stacked = (panel) => // are read together, unless each is a record of its own
      panels.filter((p) => p === panel || (p.column === panel.column && !p.title));
    const cursor = make('g', { class: 'cursor' });
    const marquee = make('rect', { class: 'marquee' });
    const values = make('output', {});
    const button = (text, title, action) => {
      const node = make('button', { type: 'button', title, 'aria-label': title }, text);
      node.addEventListener('click', action);
      return node;
    };
    const stage = make('div', {
      class: 'stage', tabindex: 0, role: 'group',
      'aria-label': 'Interactive figure: arrow keys read values, plus and minus zoom, 0 shows all',
    });
    const all = button('All', 'Show all', () => reset());
    let active = panels[0], at = null, start = null;

    const zoom = (panel, across, up) => {
      for (const p of linked(panel)) {
        p.x.zoom(...across);
        if (p === panel && up) p.y.zoom(...up);
        p.redraw();
      }
      read();
    };
    const scale = (factor) => {
      const { view } = active.x;
      const middle = at ? within(active.x.under(at.x), ...view) : (view[0] + view[1]) / 2;
      zoom(active, [middle + (view[0] - middle) * factor, middle + (view[1] - middle) * factor]);
    };
    const reset = () => {
      for (const p of panels) {
        p.x.view = [0, 1];
        p.y.view = [0, 1];
        p.redraw();
      }
      if (document.activeElement === all) stage.focus({ preventScroll: true });
      read();
    };

    function read() {
      all.hidden = panels.every((p) => p.whole);
      cursor.replaceChildren();
      values.hidden = !at;
      if (!at) return;
      const snap = active.series.find((s) => s.points && s.x.length);
      const value = snap ? snap.x[snap.nearest(active, at)] : active.x.value(active.x.under(at.x));
      const place = active.x.place(value);
      const told = [['', active.across.name || 'x', `${written(value)} ${active.across.unit}`]];
      for (const panel of stacked(active)) {
        const seen = { x: place, y: at.y };
        const found = panel.series.map((s) => [s.name, ...s.read(panel, seen, value)]);
        for (const [, x, y] of found) {
          const [cx, cy] = [panel.x.place(x), panel.y.place(y)];
          if (panel.x.holds(cx) && panel.y.holds(cy)) cursor.append(make('circle', { cx, cy, r: 2.6 }));
        }
        if (panel.x.holds(place))
          cursor.append(make('path', { d: `M${place} ${panel.y.start}v${panel.y.length}` }));
        const list = found.filter(([, , y]) => Number.isFinite(y)).map(([name, , y]) => `${name} ${written(y)}`);
        const name = [panel.title, panel.up.name].filter(Boolean).join(', ');
        if (list.length) told.push([' · ', name, `${list.join(', ')} ${panel.up.unit}`]);
      }
      values.replaceChildren(...told.flatMap(([gap, name, text]) => [gap, make('b', {}, name), ` ${text}`]));
    }

    const locate = (event) => new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
    const panelAt = ({ x, y }) => panels.find((p) => p.x.holds(x) && p.y.holds(y));
    stage.addEventListener('pointermove', (event) => {
      const place = locate(event);
      if (start) {
        const x = within(place.x, active.x.start, active.x.start + active.x.length);
        const y = within(place.y, active.y.start + active.y.length, active.y.start);
        const tall = Math.abs(y - start.y) > 2 * DRAGGED;
        const [top, bottom] = tall ? [start.y, y] : [active.y.start, active.y.start + active.y.length];
        start.end = { x, y: tall ? y : null };
        for (const [name, v] of Object.entries({
          x: Math.min(start.x, x), y: Math.min(top, bottom),
          width: Math.abs(x - start.x), height: Math.abs(bottom - top),
        })) marquee.setAttribute(name, v);
      }
      const panel = start ? active : panelAt(place);
      if (panel) [active, at] = [panel, place];
      else at = null;
      read();
    });
    stage.addEventListener('pointerdown', (event) => {
      const place = locate(event);
      const panel = panelAt(place);
      if (!panel || event.button) return;
      [active, at] = [panel, place];
      start = { x: place.x, y: place.y, end: null };
      if (event.pointerType === 'mouse') {
        event.preventDefault(); // no text is selected on the way
        stage.focus({ preventScroll: true });
        stage.setPointerCapture(event.pointerId);
      }
      read();
    });
    stage.addEventListener('pointerup', () => {
      if (start?.end && Math.abs(start.end.x - start.x) > DRAGGED)
        zoom(active, [start.x, start.end.x].map((v) => active.x.under(v)),
          start.end.y === null ? null : [start.y, start.end.y].map((v) => active.y.under(v)));
      drop();
    });
    const drop = () => {
      start = null;
      marquee.setAttribute('width', 0);
    };
    stage.addEventListener('pointercancel', drop);
    stage.addEventListener('pointerleave', () => { if (!start) { at = null; read(); } });
    stage.addEventListener('dblclick', reset);
    stage.addEventListener('keydown', (event) => {
      const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
      const turn = { ArrowUp: -1, ArrowDown: 1 }[event.key];
      const middle = () => active.y.start + active.y.length / 2;
      at ??= { x: active.x.start, y: middle() };
      if (step) {
        const snap = active.series.find((s) => s.points && s.ordered && s.x.length);
        if (snap) {
          const next = within(snap.nearest(active, at) + step, 0, snap.x.length - 1);
          at = { x: active.x.place(snap.x[next]), y: at.y };
        } else at = { x: within(at.x + (step * active.x.length) / STEPS, active.x.start, active.x.start + active.x.length), y: at.y };
      } else if (turn) {
        active = panels[within(panels.indexOf(active) + turn, 0, panels.length - 1)];
        at = { x: within(at.x, active.x.start, active.x.start + active.x.length), y: middle() };
      } else if (event.key === '+' || event.key === '=') scale(0.5);
      else if (event.key === '-') scale(2);
      else if (event.key === '0' || event.key === 'Escape') reset();
      else return;
      event.preventDefault();
      read();
    });

    stage.addEventListener('blur', () => { at = null; read(); });

    // Buttons stand on the figure, values over its caption: neither takes room of its own.
    const plot = make('div', { class: 'plot' }, stage, make('div', { class: 'tools' },
      make('span', { class: 'hint' }, 'Point for values, drag to zoom'), all,
      button('+', 'Zoom in', () => scale(0.5)), button('−', 'Zoom out', () => scale(2))), values);
    svg.before(plot);
    stage.append(svg);
    svg.append(marquee, cursor);
    read();
  }

  document.querySelectorAll('figure').forEach(explore);
})();
