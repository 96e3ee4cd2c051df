// What every page with charts shares: uPlot in the colours of the page, keys of lines, and helpers.
const charts = (() => {
  'use strict';
  const SVG = 'http://www.w3.org/2000/svg';
  const make = (name, attributes = {}, ...children) => {
    const drawn = ['svg', 'line', 'circle', 'path', 'rect', 'text', 'g'].includes(name);
    const node = drawn ? document.createElementNS(SVG, name) : document.createElement(name);
    for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
    node.append(...children);
    return node;
  };
  const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const written = (v) => (Number.isFinite(v) ? String(Number(v.toPrecision(4))).replace(/-/g, '−') : '–');
  const widened = (low, high) => {
    const room = 0.06 * (high - low) || 1;
    return [low - room, high + room];
  };
  // A line has a name, a colour (name of a custom property), strokes and gaps in px (or the name of
  // a property that lists them), and perhaps `told`, a value beside its name, and `points` for dots.
  const strokes = ({ dash }) => (Array.isArray(dash) ? dash : css(dash).split(' ').map(Number));
  const keys = (lines) => lines.map((line) => {
    const [colour, dash] = [`var(${line.colour})`, strokes(line).join(' ')];
    const mark = line.points ? make('circle', { cx: 15, cy: 5, r: 2.5, fill: colour })
      : make('line', { x1: 0, x2: 30, y1: 5, y2: 5, stroke: colour, 'stroke-width': 2, 'stroke-dasharray': dash });
    const told = line.told === undefined ? [] : [' ', make('b', {}, line.told)];
    return make('li', {}, make('svg', { viewBox: '0 0 30 10', 'aria-hidden': 'true' }, mark), line.name, ...told);
  });
  const series = (line) => {
    const colour = () => css(line.colour); // asked anew at each drawing: the page may turn dark
    const dots = { show: true, size: 2.6, width: 0, fill: colour, stroke: colour };
    return line.points ? { stroke: colour, width: 0, points: dots, paths: () => null }
      : { stroke: colour, dash: strokes(line), width: line.width ?? 1.8, points: { show: false } };
  };
  const axis = (label, size) => ({
    label, size, labelSize: 20, labelFont: '13px system-ui', font: '12px system-ui', stroke: () => css('--f-ink'),
    grid: { stroke: () => css('--f-grid'), width: 1 }, ticks: { stroke: () => css('--f-grid'), width: 1, size: 4 },
    values: (plot, splits) => splits.map((v) => (v === null ? '' : written(v))),
  });

  const drawn = new Map(); // the plot in each place, which it fills
  const fill = ({ target }) => {
    const [plot, width, height] = [drawn.get(target), target.clientWidth, target.clientHeight];
    if (width && (plot.width !== width || plot.height !== height)) plot.setSize({ width, height });
  };
  const sizes = new ResizeObserver((entries) => entries.filter((one) => drawn.has(one.target)).forEach(fill));
  matchMedia('(prefers-color-scheme: dark)').addEventListener('change', () => drawn.forEach((plot) => plot.redraw(false)));

  // Draw lines into a place; `across` and `up` name the axes, scales and other options are those of uPlot.
  function chart(place, data, lines, { across, up, x, y, hooks, cursor }) {
    const plot = new uPlot({
      width: place.clientWidth, height: place.clientHeight, legend: { show: false }, cursor,
      scales: { x: { time: false, ...x }, y }, axes: [axis(across, 26), axis(up, 56)],
      series: [{}, ...lines.map(series)],
      hooks: { ...hooks, destroy: [() => { sizes.unobserve(place); drawn.delete(place); }] },
    }, data, place);
    drawn.set(place, plot);
    sizes.observe(place);
    return plot;
  }
  return { chart, keys, make, widened, written };
})();
