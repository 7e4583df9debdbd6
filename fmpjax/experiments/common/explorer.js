// Sorts and filters the tables of the page. A table's cells hold their values in data-value, numbers as they are in
// the CSV file.
"use strict";

function compared(a, b) {
  if (a === "" || b === "") return (a === "") - (b === ""); // what is not defined is last either way
  const numbers = !Number.isNaN(Number(a)) && !Number.isNaN(Number(b));
  return numbers ? Number(a) - Number(b) : a.localeCompare(b, "en");
}

function sorted(rows, column, descending) {
  const sign = (a, b) => (descending && a[column] !== "" && b[column] !== "" ? -1 : 1);
  return [...rows].sort((a, b) => sign(a, b) * compared(a[column], b[column]));
}

function matches(row, chosen) {
  return Object.entries(chosen).every(([column, value]) => value === "" || row[column] === value);
}

function explore(table) {
  const body = table.querySelector("tbody");
  const lines = [...body.querySelectorAll("tr")];
  const values = new Map(lines.map((line) => [line, [...line.cells].map((cell) => cell.dataset.value)]));
  const headings = [...table.querySelectorAll("th")];
  const box = table.closest(".explorer");
  const filters = [...box.querySelectorAll("select")];
  const count = box.querySelector("output");

  function filter() {
    const chosen = Object.fromEntries(filters.map((select) => [select.dataset.column, select.value]));
    for (const line of lines) line.hidden = !matches(values.get(line), chosen);
    count.textContent = `${lines.filter((line) => !line.hidden).length} of ${lines.length} lines`;
  }

  headings.forEach((heading, column) => {
    heading.querySelector("button").addEventListener("click", () => {
      const descending = heading.getAttribute("aria-sort") === "ascending";
      for (const other of headings) other.removeAttribute("aria-sort");
      heading.setAttribute("aria-sort", descending ? "descending" : "ascending");
      const rows = lines.map((line) => Object.assign([...values.get(line)], { line }));
      body.append(...sorted(rows, column, descending).map((row) => row.line));
    });
  });
  for (const select of filters) select.addEventListener("change", filter);
  filter();
}

if (typeof document !== "undefined") document.querySelectorAll(".explorer table").forEach(explore);
