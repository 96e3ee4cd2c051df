// What a page can do beyond being read: copy numbers, show where the reader is, print all of it.
(() => {
  'use strict';
  const DIGITS = '⁰¹²³⁴⁵⁶⁷⁸⁹⁻';
  const asNumber = (text) => text
    .replace(/ × 10([⁰¹²³⁴-⁹⁻]+)/g, (_, e) => `e${[...e].map((c) => '0123456789-'[DIGITS.indexOf(c)]).join('')}`)
    .replace(/−/g, '-').replace(/\u00a0/g, ' ').trim();
  const textOf = (cell) => {
    const copy = cell.cloneNode(true);
    for (const math of copy.querySelectorAll('math')) math.replaceWith(math.getAttribute('alttext') ?? math.textContent);
    return asNumber(copy.textContent);
  };
  // "(5.20 ± 0.14)e-6" as value and standard error, each a number of its own.
  const parted = (text) => {
    const [, open, value, error, power] = text.match(/^(\()?(-?[\d.]+) ± ([\d.]+)\)?(e-?\d+)?/) ?? [];
    return value ? [value + (power ?? ''), error + (power ?? '')] : [text, ''];
  };
  const asTabs = (table) => {
    const rows = [...table.rows].map((row) => [...row.cells].map(textOf));
    const split = rows[0].map((_, i) => rows.some((row, k) => k && row[i]?.includes(' ± ')));
    return rows
      .map((row, k) => row.flatMap((text, i) => (split[i] ? (k ? parted(text) : [text, 'std']) : [text])).join('\t'))
      .join('\n');
  };
  const copy = async (text) => {
    try {
      await navigator.clipboard.writeText(text);
    } catch { // a page from a disk may have no clipboard of its own
      const field = document.createElement('textarea');
      field.value = text;
      document.body.append(field);
      field.select();
      document.execCommand('copy');
      field.remove();
    }
  };
  const offer = (place, what, text) => {
    const button = document.createElement('button');
    button.type = 'button';
    button.className = 'copy';
    button.textContent = 'Copy';
    button.setAttribute('aria-label', `Copy ${what}`);
    button.addEventListener('click', async () => {
      await copy(text());
      button.textContent = 'Copied';
      setTimeout(() => { button.textContent = 'Copy'; }, 1500);
    });
    place(button);
  };
  for (const table of document.querySelectorAll('table.numbered')) {
    const caption = document.getElementById(table.getAttribute('aria-labelledby'));
    offer((b) => caption.append(b), caption.querySelector('b').textContent.replace('.', ''), () => asTabs(table));
  }
  for (const formula of document.querySelectorAll('[data-copy]'))
    offer((b) => formula.after(b), 'these numbers', () => formula.dataset.copy);

  const links = new Map([...document.querySelectorAll('nav a')].map((a) => [a.hash.slice(1), a]));
  const seen = new IntersectionObserver((entries) => {
    for (const { target, isIntersecting } of entries) {
      if (!isIntersecting) continue;
      for (const link of links.values()) link.removeAttribute('aria-current');
      links.get(target.id)?.setAttribute('aria-current', 'true');
    }
  }, { rootMargin: '-10% 0px -80% 0px' });
  for (const section of document.querySelectorAll('main > section')) seen.observe(section);

  let closed = [];
  addEventListener('beforeprint', () => {
    closed = [...document.querySelectorAll('details:not([open])')];
    for (const details of closed) details.open = true;
  });
  addEventListener('afterprint', () => { for (const details of closed) details.open = false; });
  // A link into something closed opens it.
  const open = () => { const to = document.getElementById(location.hash.slice(1)); const d = to?.closest('details'); if (d) d.open = true; };
  addEventListener('hashchange', open);
  open();
})();
