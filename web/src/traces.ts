// Light over time of the regions, and its spectrum.

import { Chart, type Curve } from "./chart";
import { REGION_COLOURS } from "./colour";
import { download, h } from "./dom";
import { hertz, number } from "./format";
import { align, alignedPoints, readSignal, type Signal } from "./photodiode";
import { isSame, MAX_REGIONS, type Regions, titleOf, within, wordsOf } from "./regions";
import { type Spectrum, spectrum } from "./spectrum";
import type { Region, Store } from "./store";
import type { KnownTrace } from "./types";
import type { Volume } from "./volume";

/** Regions that are shown at first where the user asked for none. */
const FIRST = 3;

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
  /** Bins that were there when the curves were drawn. */
  private drawnBins = -1;

  constructor(
    private readonly store: Store,
    private readonly regions: Regions,
  ) {
    const { clock } = store;
    this.time = new Chart({
      label: "Light of the regions over time",
      x: `time (${clock.unit})`,
      y: `light (${store.unit})`,
      right: store.otherRatio === 1 ? "" : `light of ${store.source.results[1].name}`,
      height: 250,
      onPick: (x) => store.goTo(clock.bin(x)),
      mark: () => clock.at(store.state.t),
    });
    this.frequency = new Chart({
      label: "Amplitude of the regions over frequency",
      x: clock.step_us == null ? "frequency (per bin)" : "frequency (kHz)",
      y: `amplitude (${store.unit})`,
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
    const rois = h("input", {
      type: "file",
      id: "load-regions-file",
      accept: ".roi,.zip",
      class: "unseen",
      tabindex: -1,
      "aria-hidden": "true",
      change: () => {
        for (const chosen of rois.files ?? []) void regions.load(chosen);
        rois.value = "";
      },
    });
    const several = clock.bins > 1;
    this.element = h(
      "div",
      {},
      h("p", { class: "muted note" }, "Click a pixel or drag a region in the picture. Arrow keys move the region that has the focus, with Shift they change its size."),
      this.list,
      h(
        "div",
        { class: "row region-files" },
        h("button", { type: "button", id: "save-regions", title: "For ImageJ's ROI Manager, and for this page", click: () => regions.save() }, "Save regions"),
        h("button", { type: "button", id: "load-regions", title: "A .roi or .zip of ImageJ", click: () => rois.click() }, "Load regions"),
        rois,
        h("button", { type: "button", class: "quiet", click: () => store.set({ regions: [], selected: null }, "regions") }, "Remove all"),
      ),
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

  /** Adds the regions to begin with: all that were asked for; where there are none, those whose light repeats, else the brightest. */
  begin(): void {
    const known = (this.store.meta.view?.traces ?? []).map((trace, i) => ({ ...trace, number: trace.number ?? i + 1 }));
    const requested = known.filter((t) => t.requested);
    const periodic = known.filter((t) => t.frequency_hz != null);
    const chosen = requested.length > 0 ? requested.slice(0, MAX_REGIONS) : (periodic.length > 0 ? periodic : known).slice(0, FIRST);
    for (const { region, number, colour } of chosen) this.regions.add(region, { number, colour: colour ?? REGION_COLOURS[number - 1] });
    this.store.state.selected = null;
  }

  private known(region: Region): KnownTrace | undefined {
    return this.store.meta.view?.traces?.find((t) => isSame(t.region, region));
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
          const [x, y] = alignedPoints(signal, found, clock);
          if (this.shown.photodiode) curves.push({ label: signal.name, colour: `${region.colour}90`, x, y, width: 1 });
          words = `${signal.name}: correlation ${found.correlation.toFixed(3)} with ${titleOf(region)}, shifted by ${number(found.shift_us, 3)} µs`;
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

  /** The videos whose curves are drawn. */
  private get volumes(): Volume[] {
    const { video, truth, other } = this.store;
    return [video, truth, other].filter((volume) => volume != null);
  }

  private get loadedBins(): number {
    return this.volumes.reduce((bins, volume) => bins + volume.count, 0);
  }

  /** Draws soon, but not for each of many bins that come in. */
  private later(): void {
    if (this.pending || this.loadedBins === this.drawnBins) return;
    this.pending = true;
    setTimeout(
      () => {
        this.pending = false;
        this.draw();
      },
      this.volumes.every((volume) => volume.isWhole) ? 0 : 400,
    );
  }

  private rate(): number {
    const { step_us } = this.store.clock;
    return step_us == null ? 1 : 1e6 / step_us;
  }

  private draw(): void {
    const { store } = this;
    const { clock } = store;
    this.drawnBins = this.loadedBins;
    const x = Float64Array.from({ length: clock.bins }, (_, t) => clock.at(t));
    const curves: Curve[] = [];
    const spectra: Curve[] = [];
    const rows: HTMLElement[] = [];
    let banded = false;
    const overlaid: { region: Region; values: Float64Array }[] = [];
    for (const region of store.state.regions) {
      const { colour } = region;
      const name = titleOf(region);
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
        const right = store.otherRatio !== 1;
        if (there) curves.push({ label: `${name}, other`, colour, x: otherX, y: store.other.trace(there), dash: [2, 3], width: 1.5, right });
      }
      if (this.shown.photodiode) {
        for (const diode of known?.photodiodes ?? []) {
          const kept = diode.points.filter(([t]) => t >= clock.start && t <= clock.end);
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
    const focused = this.list.contains(document.activeElement) ? (document.activeElement as HTMLElement).closest("li")?.dataset.id : undefined;
    const isNaming = document.activeElement instanceof HTMLInputElement && this.list.contains(document.activeElement);
    if (!isNaming) {
      this.list.replaceChildren(...rows);
      if (focused !== undefined) this.list.querySelector<HTMLElement>(`li[data-id="${focused}"] .place`)?.focus();
    }
    this.time.set(curves);
    this.frequency.set(spectra);
    const words = [];
    if (banded) words.push("Bands: 95 % confidence intervals of the debiased values, from the frame's noise.");
    if (store.other && store.otherRatio !== 1) {
      words.push(
        `${store.source.results[1].name} has other units: its values reach ${number(store.otherRatio, 2)} times those of ${store.meta.name}. Its curves (dotted) have the axis on the right.`,
      );
    }
    if (store.axesWords) words.push(store.axesWords);
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
    const isSelected = region.id === store.state.selected;
    return h(
      "li",
      {
        "data-id": region.id,
        "data-y": region.y,
        "data-x": region.x,
        "data-rows": region.rows,
        "data-columns": region.columns,
        "data-peak-hz": timed && peak != null ? peak.toFixed(1) : null,
        class: isSelected ? "selected" : null,
      },
      swatch,
      h(
        "button",
        {
          type: "button",
          class: "place",
          title: "Enter: a name; arrows: move; with Shift: size; Delete: remove",
          "aria-pressed": String(isSelected),
          click: () => this.regions.select(region.id),
          dblclick: () => this.name(region),
          keydown: (event: KeyboardEvent) => this.keyOn(region, event),
        },
        name,
      ),
      h("button", { type: "button", class: "icon rename", "aria-label": `Name ${name}`, title: "Name", click: () => this.name(region) }, "✎"),
      h("span", { class: "frequency", title: known?.frequency_hz != null ? "Sine that fits best, with its standard error" : "Peak of the spectrum" }, text),
      h("span", { class: "muted" }, `peak ${number(most, 3)}`),
      h(
        "button",
        {
          type: "button",
          class: "icon",
          "aria-label": `Remove ${name}`,
          click: () => this.regions.remove(region.id),
        },
        "×",
      ),
    );
  }

  /** Keys on a region of the list: place, size, name, removal. */
  private keyOn(region: Region, event: KeyboardEvent): void {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const ways: Record<string, [number, number]> = { ArrowLeft: [0, -1], ArrowRight: [0, 1], ArrowUp: [-1, 0], ArrowDown: [1, 0] };
    const way = ways[event.key];
    if (way) {
      const [dy, dx] = way;
      // The list may not show yet where the last key has put it.
      const { y, x, rows, columns } = this.regions.all.find((r) => r.id === region.id) ?? region;
      const rect = event.shiftKey ? { y, x, rows: rows + dy, columns: columns + dx } : { y: y + dy, x: x + dx, rows, columns };
      this.store.state.selected = region.id;
      this.regions.place(region.id, rect);
    } else if (event.key === "Enter" || event.key === "F2") {
      this.name(region);
    } else if (event.key === "Delete" || event.key === "Backspace") {
      this.regions.remove(region.id);
    } else {
      return;
    }
    event.preventDefault();
    event.stopPropagation();
  }

  /** Lets the user name a region, in its place in the list. */
  private name(region: Region): void {
    const place = this.list.querySelector(`li[data-id="${region.id}"] .place`);
    if (!place) return;
    let isDone = false;
    const done = (keep: boolean) => {
      if (isDone) return;
      isDone = true;
      input.replaceWith(place);
      (place as HTMLElement).focus();
      if (keep) this.regions.rename(region.id, input.value);
      else this.store.tell("regions");
    };
    const input = h("input", {
      type: "text",
      class: "region-name",
      value: region.name,
      placeholder: wordsOf(region),
      "aria-label": `Name of region ${region.number}`,
      maxlength: 60,
      blur: () => done(true),
      keydown: (event: KeyboardEvent) => {
        if (event.key === "Enter" || event.key === "Escape") done(event.key === "Enter");
        event.stopPropagation();
      },
    });
    place.replaceWith(input);
    input.focus();
    input.select();
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
