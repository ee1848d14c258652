// Light over time of the regions, and its spectrum.

import { Chart, type Curve } from "./chart";
import { download, h } from "./dom";
import { hertz, number } from "./format";
import { align, alignedPoints, readSignal, type Signal } from "./photodiode";
import { type Spectrum, spectrum } from "./spectrum";
import type { Region, Store } from "./store";
import type { KnownTrace, Rect } from "./types";

/** Half the width of the interval that holds 95 of 100 values, over the standard error. */
const NINETY_FIVE = 1.96;

export class Traces {
  readonly element: HTMLElement;
  private readonly time: Chart;
  private readonly frequency: Chart;
  private readonly list: HTMLElement;
  private readonly note: HTMLElement;
  private readonly overlays: HTMLElement;
  private readonly shown = { truth: true, other: true, photodiode: true };
  private readonly ticked = new Set<string>();
  /** Photodiodes that were loaded in the page. */
  private signals: Signal[] = [];
  private readonly diodes: HTMLElement;
  private pending = false;
  private seen = -1;

  constructor(private readonly store: Store) {
    const { clock } = store;
    this.time = new Chart({
      label: "Light of the regions over time",
      x: `time (${clock.unit})`,
      y: "light (counts)",
      height: 250,
      onPick: (x) => store.goTo(clock.bin(x)),
      mark: () => clock.at(store.state.t),
    });
    this.frequency = new Chart({
      label: "Amplitude of the regions over frequency",
      x: clock.step_us == null ? "frequency (per bin)" : "frequency (kHz)",
      y: "amplitude (counts)",
      height: 210,
    });
    this.list = h("ul", { class: "regions", "aria-label": "Regions" });
    this.note = h("p", { class: "muted note" });
    this.overlays = h("div", { class: "row overlays" });
    this.diodes = h("ul", { class: "muted note diodes", role: "status" });
    const file = h("input", {
      type: "file",
      id: "photodiode",
      accept: ".csv,.txt,text/csv,text/plain",
      multiple: true,
      class: "unseen",
      tabindex: -1,
      "aria-hidden": "true",
      change: () => void this.load(file.files),
    });
    const several = clock.bins > 1;
    this.element = h(
      "div",
      {},
      h("p", { class: "muted note" }, "Click a pixel or drag a region in the picture."),
      this.list,
      this.overlays,
      this.time.element,
      this.note,
      this.diodes,
      several && h("h3", {}, "Spectrum"),
      several && this.frequency.element,
      h(
        "div",
        { class: "row" },
        h("button", { type: "button", id: "save-csv", click: () => this.save() }, "Save traces as CSV"),
        clock.step_us != null &&
          h(
            "button",
            { type: "button", id: "load-photodiode", title: "A CSV file time_us,value; it may also be dropped here", click: () => file.click() },
            "Overlay a photodiode",
          ),
        file,
        h("button", { type: "button", class: "quiet", click: () => store.set({ regions: [] }, "regions") }, "Remove all"),
      ),
    );
    this.element.addEventListener("dragover", (event) => event.preventDefault());
    this.element.addEventListener("drop", (event) => {
      event.preventDefault();
      void this.load(event.dataTransfer?.files ?? null);
    });
    this.tickBoxes();
    store.on((what) => {
      if (what === "time") this.time.mark();
      if (what === "regions") this.draw();
      if (what === "data") this.later();
    });
  }

  /** Regions to begin with: those whose light repeats, else the brightest. */
  static first(store: Store): Rect[] {
    const known = store.meta.view?.traces ?? [];
    const periodic = known.filter((t) => t.frequency_hz != null);
    const chosen = (periodic.length > 0 ? periodic : known).slice(0, 3);
    return chosen.map((t) => t.region);
  }

  private known(region: Rect): KnownTrace | undefined {
    return this.store.meta.view?.traces?.find(
      ({ region: r }) => r.y === region.y && r.x === region.x && r.rows === region.rows && r.columns === region.columns,
    );
  }

  /** Takes photodiodes from files, and says what is wrong with those that are none. */
  private async load(files: FileList | null): Promise<void> {
    if (this.store.clock.step_us == null) return;
    const faults: string[] = [];
    for (const file of files ?? []) {
      try {
        const signal = await readSignal(file);
        this.signals = [...this.signals.filter((s) => s.name !== signal.name), signal];
      } catch (error) {
        faults.push(error instanceof Error ? error.message : String(error));
      }
    }
    this.tickBoxes();
    this.draw();
    this.diodes.append(...faults.map((words) => h("li", { class: "error" }, words)));
  }

  /** Curves of the photodiodes that were loaded, each over the region that it fits best. */
  private overlay(regions: { region: Region; values: Float64Array }[]): Curve[] {
    const { clock } = this.store;
    const curves: Curve[] = [];
    const lines = this.signals.map((signal) => {
      let words: string;
      try {
        const found = align(signal, regions.map((r) => r.values), clock);
        if (!found) words = `${signal.name} fits no region: pick one that changes while the signal lasts.`;
        else {
          const { region } = regions[found.trace];
          const [x, y] = alignedPoints(signal, found, clock.bins * (clock.step_us ?? 1));
          if (this.shown.photodiode) curves.push({ label: signal.name, colour: `${region.colour}90`, x, y, width: 1 });
          words = `${signal.name}: correlation ${found.correlation.toFixed(3)} with ${wordsOf(region)}, shifted by ${number(found.shift_us, 3)} µs`;
        }
      } catch (error) {
        words = error instanceof Error ? error.message : String(error);
      }
      return h("li", {}, words);
    });
    this.diodes.replaceChildren(...lines);
    return curves;
  }

  private tickBoxes(): void {
    const { store } = this;
    const kinds: [keyof typeof this.shown, string, boolean][] = [
      ["truth", "Truth (dashed)", store.truth != null],
      ["other", `${store.source.results[1]?.name} (dotted)`, store.other != null],
      ["photodiode", "Photodiode", (store.meta.view?.traces ?? []).some((t) => t.photodiodes.length > 0) || this.signals.length > 0],
    ];
    for (const [kind, text, there] of kinds) {
      if (!there || this.ticked.has(kind)) continue;
      this.ticked.add(kind);
      const box = h("input", {
        type: "checkbox",
        id: `over-${kind}`,
        checked: true,
        change: () => {
          this.shown[kind] = box.checked;
          this.draw();
        },
      });
      this.overlays.append(h("label", {}, box, ` ${text}`));
    }
  }

  /** Draws soon, but not for each of many bins that come in. */
  private later(): void {
    if (this.pending || this.store.video.count === this.seen) return;
    this.pending = true;
    setTimeout(
      () => {
        this.pending = false;
        this.draw();
      },
      this.store.video.isWhole ? 0 : 400,
    );
  }

  private rate(): number {
    const { step_us } = this.store.clock;
    return step_us == null ? 1 : 1e6 / step_us;
  }

  private draw(): void {
    const { store } = this;
    const { clock } = store;
    this.seen = store.video.count;
    const x = Float64Array.from({ length: clock.bins }, (_, t) => clock.at(t));
    const curves: Curve[] = [];
    const spectra: Curve[] = [];
    const rows: HTMLElement[] = [];
    let banded = false;
    const overlaid: { region: Region; values: Float64Array }[] = [];
    for (const region of store.state.regions) {
      const { colour } = region;
      const name = wordsOf(region);
      const values = store.video.trace(region);
      const known = this.known(region);
      curves.push({ label: name, colour, x, y: values, points: clock.bins < 80 });
      // As the program does it: over the refitted values, where they are known.
      const refitted = known?.debiased.every((v) => v != null) ? Float64Array.from(known.debiased as number[]) : values;
      overlaid.push({ region, values: refitted });
      if (known && known.standard_error.some((e) => e != null)) {
        banded = true;
        const error = known.standard_error.map((e) => (e == null ? null : NINETY_FIVE * e));
        curves.push({ label: `${name}, refitted`, colour, x, y: known.debiased, error, width: 0 });
      }
      if (store.truth && this.shown.truth) {
        curves.push({ label: `${name}, truth`, colour, x, y: store.truth.trace(region), dash: [6, 4], width: 1.25 });
      }
      if (store.other && store.otherClock && this.shown.other) {
        const there = within(region, store.other.rows, store.other.columns);
        const otherX = Float64Array.from({ length: store.otherClock.bins }, (_, t) => store.otherClock!.at(t));
        if (there) curves.push({ label: `${name}, other`, colour, x: otherX, y: store.other.trace(there), dash: [2, 3], width: 1.5 });
      }
      if (this.shown.photodiode) {
        for (const diode of known?.photodiodes ?? []) {
          const kept = diode.points.filter(([t]) => t >= 0 && t <= x[x.length - 1] + x[0]);
          curves.push({
            label: diode.name,
            colour: `${colour}90`,
            x: kept.map((p) => p[0]),
            y: kept.map((p) => p[1]),
            width: 1,
          });
        }
      }
      const found = spectrum(values, this.rate());
      const scale = clock.step_us == null ? 1 : 1e-3;
      spectra.push({ label: name, colour, x: found.frequency.map((f) => f * scale), y: found.amplitude });
      rows.push(this.item(region, name, found, known, values));
    }
    curves.push(...this.overlay(overlaid));
    this.list.replaceChildren(...rows);
    this.time.set(curves);
    this.frequency.set(spectra);
    const words = [];
    if (banded) words.push("Bands: 95 % confidence intervals of the debiased values, from the frame's noise.");
    if (!store.video.isWhole) words.push("The video is still loading.");
    if (store.source.isOffline) words.push("Values of this file have 8 bits; video.npy has all.");
    this.note.textContent = words.join(" ");
    this.time.element.hidden = this.frequency.element.hidden = curves.length === 0;
  }

  private item(region: Region, name: string, { peak_hz: peak, isConstant }: Spectrum, known: KnownTrace | undefined, values: Float64Array): HTMLElement {
    const { store } = this;
    const swatch = h("span", { class: "swatch", "aria-hidden": "true" });
    swatch.style.background = region.colour;
    // Where the report has tested the trace, its answer counts.
    const frequency = known ? known.frequency_hz : peak;
    const timed = store.clock.step_us != null;
    const text =
      frequency == null
        ? isConstant
          ? "nothing changes"
          : "no frequency stands out"
        : timed
          ? hertz(frequency, known?.frequency_error_hz)
          : `${number(frequency, 3)} per bin`;
    const most = values.reduce((a, b) => (b > a ? b : a), -Infinity);
    const { regions } = store.state;
    return h(
      "li",
      { "data-y": region.y, "data-x": region.x, "data-peak-hz": timed && peak != null ? peak.toFixed(1) : null },
      swatch,
      h("span", { class: "place" }, name),
      h("span", { class: "frequency", title: known?.frequency_hz != null ? "Sine that fits best, with its standard error" : "Peak of the spectrum" }, text),
      h("span", { class: "muted" }, `peak ${number(most, 3)}`),
      h(
        "button",
        {
          type: "button",
          class: "icon",
          "aria-label": `Remove ${name}`,
          click: () => store.set({ regions: regions.filter((r) => r.id !== region.id) }, "regions"),
        },
        "×",
      ),
    );
  }

  /** A line for each bin: its middle, and the regions' values, errors, truth. */
  csv(): string {
    const { store } = this;
    const { clock } = store;
    const columns: { name: string; at: (t: number) => number | null | undefined }[] = [
      { name: clock.step_us == null ? "bin" : "time_us", at: (t) => (clock.step_us == null ? t : clock.at(t)) },
    ];
    for (const region of store.state.regions) {
      const place = `y${region.y}_x${region.x}_${region.rows}x${region.columns}`;
      const values = store.video.trace(region);
      columns.push({ name: `${place}_value`, at: (t) => values[t] });
      const known = this.known(region);
      if (known) {
        columns.push({ name: `${place}_debiased`, at: (t) => known.debiased[t] });
        columns.push({ name: `${place}_standard_error`, at: (t) => known.standard_error[t] });
      }
      if (store.truth) {
        const truth = store.truth.trace(region);
        columns.push({ name: `${place}_truth`, at: (t) => truth[t] });
      }
    }
    const lines = [columns.map((c) => c.name).join(",")];
    for (let t = 0; t < clock.bins; t++) {
      const cell = (v: number | null | undefined) => (v == null || !Number.isFinite(v) ? "" : String(Number(v.toPrecision(7))));
      lines.push(columns.map((c) => cell(c.at(t))).join(","));
    }
    return `${lines.join("\n")}\n`;
  }

  private save(): void {
    download(`${this.store.meta.name}-traces.csv`, new Blob([this.csv()], { type: "text/csv" }));
  }
}

function wordsOf({ y, x, rows, columns }: Rect): string {
  const middle = `row ${y + (rows >> 1)}, column ${x + (columns >> 1)}`;
  return rows * columns === 9 && rows === 3 ? middle : `${middle} (${rows}×${columns})`;
}

function within(rect: Rect, rows: number, columns: number): Rect | null {
  const [y1, x1] = [Math.min(rows, rect.y + rect.rows), Math.min(columns, rect.x + rect.columns)];
  return y1 > rect.y && x1 > rect.x ? { y: rect.y, x: rect.x, rows: y1 - rect.y, columns: x1 - rect.x } : null;
}
