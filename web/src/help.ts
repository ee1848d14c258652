// The help: what the keys and the mouse do.

import { h } from "./dom";
import type { Keys } from "./keys";

const MOUSE: [string, string][] = [
  ["Region: click, drag", "a region of 3×3 pixels, or of the size that is dragged"],
  ["Region: drag one, or its edge", "moves it, or changes its size"],
  ["Line: drag", "a line with its length; its slice is under Space–time"],
  ["Move: drag", "moves the picture"],
  ["Wheel, double click", "zooms; shows all"],
  ["Slices: click or drag", "goes to that time; with Slope, measures a speed"],
];

export class Help {
  readonly dialog: HTMLDialogElement;
  readonly button: HTMLButtonElement;

  constructor(private readonly keys: Keys) {
    this.dialog = h("dialog", { id: "help", class: "help", "aria-labelledby": "help-title" });
    this.button = h("button", { type: "button", class: "quiet", id: "open-help", click: () => this.toggle() }, "Keys and mouse (?)");
    keys.add("Page", "?", "this help", { "?": () => this.toggle() });
    this.dialog.addEventListener("keydown", (event) => {
      if (event.key === "?") this.dialog.close();
    });
  }

  private toggle(): void {
    if (this.dialog.open) {
      this.dialog.close();
      return;
    }
    this.fill();
    this.dialog.showModal();
  }

  private fill(): void {
    const groups = [...new Set(this.keys.bindings.map((b) => b.group))];
    const table = (caption: string, rows: [string, string][], asKeys: boolean) =>
      h(
        "table",
        {},
        h("caption", {}, caption),
        h("tbody", {}, ...rows.map(([name, text]) => h("tr", {}, h("th", { scope: "row" }, asKeys ? h("kbd", {}, name) : name), h("td", {}, text)))),
      );
    const tables = groups.map((group) =>
      table(group, this.keys.bindings.filter((b) => b.group === group).map((b): [string, string] => [b.label, b.text]), true),
    );
    this.dialog.replaceChildren(
      h("form", { method: "dialog", class: "row" }, h("h2", { id: "help-title" }, "Keys and mouse"), h("span", { class: "spring" }), h("button", { id: "close-help" }, "Close")),
      h("div", { class: "help-tables" }, ...tables, table("Mouse", MOUSE, false)),
    );
  }
}
