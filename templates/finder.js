// A long table that a reader searches and sorts: a field above it, and its headings as buttons.
(() => {
  'use strict';
  const asNumber = (text) => Number(text.replace(/−/g, '-').replace(/[\s%]/g, '') || NaN);
  const byText = new Intl.Collator(undefined, { numeric: true, sensitivity: 'base' }).compare;
  const compare = (a, b) => {
    const [x, y] = [asNumber(a), asNumber(b)];
    if (!Number.isNaN(x) && !Number.isNaN(y)) return x - y;
    if (Number.isNaN(x) !== Number.isNaN(y)) return Number.isNaN(x) ? 1 : -1; // numbers first
    return byText(a, b);
  };
  for (const table of document.querySelectorAll('table.finder')) {
    const body = table.tBodies[0];
    const rows = [...body.rows];
    const plain = (text) => text.normalize('NFKD').replace(/\p{M}/gu, '').toLowerCase();
    const texts = new Map(rows.map((row) => [row, plain(row.textContent)]));

    const field = document.createElement('input');
    field.type = 'search';
    field.autocomplete = 'off';
    const label = document.createElement('label');
    label.append('Search ', field);
    const told = document.createElement('output');
    const bar = document.createElement('p');
    bar.className = 'find';
    bar.append(label, told);
    table.closest('.wide').before(bar);
    field.addEventListener('input', () => {
      const words = plain(field.value).split(/\s+/).filter(Boolean);
      let shown = 0;
      for (const row of rows) {
        row.hidden = !words.every((word) => texts.get(row).includes(word));
        shown += !row.hidden;
      }
      told.textContent = words.length ? `${shown} of ${rows.length}` : '';
    });

    [...table.tHead.rows[0].cells].forEach((head, column) => {
      const button = document.createElement('button');
      button.type = 'button';
      button.className = 'sort';
      button.append(...head.childNodes);
      head.append(button);
      button.addEventListener('click', () => {
        const down = head.getAttribute('aria-sort') === 'ascending';
        for (const other of table.tHead.rows[0].cells) other.removeAttribute('aria-sort');
        head.setAttribute('aria-sort', down ? 'descending' : 'ascending');
        const text = (row) => row.cells[column].textContent.trim();
        const order = rows.slice().sort((a, b) => compare(text(a), text(b)) * (down ? -1 : 1));
        body.append(...order);
      });
    });
  }
})();
