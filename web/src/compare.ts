// Two results side by side: their verdicts, numbers and settings, those that differ first.

import { h } from "./dom";
import type { Store } from "./store";
import type { Meta } from "./types";

/** A row of the table: what, and what each result says. */
export interface Difference {
  name: string;
  values: [string, string];
  differs: boolean;
}

const NONE = "–";

/** All rows of a group of settings that either result has. */
export function rowsOf(first: [string, string][], second: [string, string][]): Difference[] {
  const [a, b] = [new Map(first), new Map(second)];
  return [...new Set([...a.keys(), ...b.keys()])].map((name) => {
    const values: [string, string] = [a.get(name) ?? NONE, b.get(name) ?? NONE];
    return { name, values, differs: values[0] !== values[1] };
  });
}

function fitOf({ view }: Meta): [string, string][] {
  const { fit } = view ?? {};
  return fit ? [["Fit", fit.verdict], ["Why", fit.reason]] : [];
}

/** The table; what is alike in both folds away. */
export function compare(store: Store): HTMLElement | null {
  const [first, second] = store.source.results;
  if (!second) return null;
  const table = (caption: string, rows: Difference[]) =>
    h(
      "table",
      { class: "comparison" },
      h("caption", {}, caption),
      h("thead", {}, h("tr", {}, h("th", {}, ""), h("th", { scope: "col" }, first.name), h("th", { scope: "col" }, second.name))),
      h(
        "tbody",
        {},
        ...rows.map(({ name, values, differs }) =>
          h("tr", { class: differs ? "differs" : null }, h("th", { scope: "row" }, name), ...values.map((v) => h("td", {}, v))),
        ),
      ),
    );
  const element = h("div", { class: "settings", id: "compare" });
  const numbers = (meta: Meta) => (meta.view?.headline ?? []).filter(([name]) => name !== "Fit");
  element.append(table("Fit and numbers", [...rowsOf(fitOf(first), fitOf(second)), ...rowsOf(numbers(first), numbers(second))]));
  const groups = new Set([first, second].flatMap((meta) => (meta.view?.settings ?? []).map(([name]) => name)));
  const group = (meta: Meta, name: string) => meta.view?.settings?.find(([of]) => of === name)?.[1] ?? [];
  const all = [...groups].map((name) => ({ name, rows: rowsOf(group(first, name), group(second, name)) }));
  const differing = all.map(({ name, rows }) => ({ name, rows: rows.filter((r) => r.differs) })).filter(({ rows }) => rows.length > 0);
  const alike = all.map(({ name, rows }) => ({ name, rows: rows.filter((r) => !r.differs) })).filter(({ rows }) => rows.length > 0);
  if (groups.size === 0) element.append(h("p", { class: "muted" }, "Neither has settings: both are single videos, or results of an earlier version."));
  else if (differing.length === 0) element.append(h("p", { class: "muted" }, "All settings are alike."));
  for (const { name, rows } of differing) element.append(table(name, rows));
  if (alike.length > 0) {
    element.append(h("details", {}, h("summary", {}, "Settings that are alike"), ...alike.map(({ name, rows }) => table(name, rows))));
  }
  return element;
}
