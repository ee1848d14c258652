// The regions whose light is followed: added, moved, named, saved and loaded.

import { REGION_COLOURS } from "./colour";
import { download, notify } from "./dom";
import { decodeRois, encodeRois, type Roi } from "./roi";
import type { Region, Store } from "./store";
import type { Rect } from "./types";

/** As many regions as there are colours. */
export const MAX_REGIONS = REGION_COLOURS.length;
/** Side of the region that a click picks, as that of `--region Y,X`. */
const SIDE = 3;

export class Regions {
  private nextId = 1;

  constructor(private readonly store: Store) {}

  get all(): Region[] {
    return this.store.state.regions;
  }

  get selected(): Region | undefined {
    return this.all.find((r) => r.id === this.store.state.selected);
  }

  /** Adds a region and selects it; one that is there already is selected alone. Null where there is no room. */
  add(rect: Rect, more: { name?: string; number?: number; colour?: string } = {}): Region | null {
    const same = this.all.find((r) => isSame(r, rect));
    if (same) {
      this.select(same.id);
      return same;
    }
    if (this.all.length >= MAX_REGIONS) {
      notify(`There are ${MAX_REGIONS} regions, as many as can be told apart. Remove one first.`);
      return null;
    }
    const [numbers, colours] = [new Set(this.all.map((r) => r.number)), new Set(this.all.map((r) => r.colour))];
    const free = REGION_COLOURS.findIndex((colour, i) => !colours.has(colour) && !numbers.has(i + 1));
    const region: Region = {
      y: rect.y,
      x: rect.x,
      rows: rect.rows,
      columns: rect.columns,
      id: this.nextId++,
      number: more.number ?? (free >= 0 ? free + 1 : firstFree(numbers)),
      colour: more.colour ?? REGION_COLOURS[free] ?? REGION_COLOURS.find((c) => !colours.has(c))!,
      name: more.name ?? "",
    };
    this.store.set({ regions: [...this.all, region], selected: region.id }, "regions");
    return region;
  }

  /** The region that a click on a pixel means: about it, cut off at the edges. */
  about(y: number, x: number): Rect {
    const { rows, columns } = this.store.video;
    const from = (v: number) => Math.max(0, v - (SIDE >> 1));
    const to = (v: number, size: number) => Math.min(size, v + (SIDE >> 1) + 1);
    return { y: from(y), x: from(x), rows: to(y, rows) - from(y), columns: to(x, columns) - from(x) };
  }

  /** Gives a region another place or size, within the picture. */
  place(id: number, rect: Rect): void {
    const { rows, columns } = this.store.video;
    const size = (n: number, most: number) => Math.min(most, Math.max(1, Math.round(n)));
    const [tall, wide] = [size(rect.rows, rows), size(rect.columns, columns)];
    const at = (v: number, most: number) => Math.min(most, Math.max(0, Math.round(v)));
    this.change(id, { y: at(rect.y, rows - tall), x: at(rect.x, columns - wide), rows: tall, columns: wide });
  }

  rename(id: number, name: string): void {
    this.change(id, { name: name.trim().slice(0, 60) });
  }

  remove(id: number): void {
    this.store.set({ regions: this.all.filter((r) => r.id !== id) }, "regions");
  }

  select(id: number | null): void {
    this.store.set({ selected: id }, "regions");
  }

  /** Selects the next region, or the one before. */
  step(by: number): void {
    if (this.all.length === 0) return;
    const at = this.all.findIndex((r) => r.id === this.store.state.selected);
    const next = at < 0 ? 0 : (at + by + this.all.length) % this.all.length;
    this.select(this.all[next].id);
  }

  private change(id: number, change: Partial<Region>): void {
    this.store.set({ regions: this.all.map((r) => (r.id === id ? { ...r, ...change } : r)) }, "regions");
  }

  /** Keeps all regions and the line as a set of ImageJ. */
  save(): void {
    const { line } = this.store.state;
    const rois: Roi[] = this.all.map((r) => ({ name: r.name || `region ${r.number}`, rect: r, line: null, isBox: false }));
    if (line) rois.push({ name: "line", rect: null, line, isBox: false });
    if (rois.length === 0) {
      notify("There is no region to be saved.");
      return;
    }
    download(`${this.store.meta.name}-regions.zip`, new Blob([encodeRois(rois) as BlobPart], { type: "application/zip" }));
  }

  /** Takes the regions of a file of ImageJ beside those that are there. */
  async load(file: File): Promise<void> {
    let rois: Roi[];
    try {
      rois = decodeRois(new Uint8Array(await file.arrayBuffer()), file.name);
    } catch (error) {
      notify(error instanceof Error ? error.message : `${file.name} cannot be read.`);
      return;
    }
    const { rows, columns } = this.store.video;
    let [taken, outside, full] = [0, 0, 0];
    for (const { name, rect, line } of rois) {
      if (line) {
        this.store.set({ line }, "line");
        taken++;
      } else {
        const part = rect && within(rect, rows, columns);
        if (!part) outside++;
        else if (this.all.length >= MAX_REGIONS && !this.all.some((r) => isSame(r, part))) full++;
        else {
          this.add(part, { name: /^region \d+$/.test(name) ? "" : name });
          taken++;
        }
      }
    }
    const boxes = rois.filter((r) => r.isBox).length;
    const words = [`${taken} of ${rois.length} regions of ${file.name} are shown`];
    if (outside) words.push(`${outside} lie outside the picture`);
    if (full) words.push(`for ${full} there is no room: ${MAX_REGIONS} can be told apart`);
    if (boxes) words.push(`${boxes} that are no rectangles are shown as their bounding boxes`);
    notify(`${words.join("; ")}.`);
  }
}

function firstFree(numbers: Set<number>): number {
  let n = 1;
  while (numbers.has(n)) n++;
  return n;
}

export function isSame(a: Rect, b: Rect): boolean {
  return a.y === b.y && a.x === b.x && a.rows === b.rows && a.columns === b.columns;
}

/** The part of `rect` within a picture; null where there is none. */
export function within(rect: Rect, rows: number, columns: number): Rect | null {
  const [y0, x0] = [Math.max(0, rect.y), Math.max(0, rect.x)];
  const [y1, x1] = [Math.min(rows, rect.y + rect.rows), Math.min(columns, rect.x + rect.columns)];
  return y1 > y0 && x1 > x0 ? { y: y0, x: x0, rows: y1 - y0, columns: x1 - x0 } : null;
}

/** Where a region lies, in words. */
export function wordsOf({ y, x, rows, columns }: Rect): string {
  const middle = `row ${y + (rows >> 1)}, column ${x + (columns >> 1)}`;
  return rows === 3 && columns === 3 ? middle : `${middle} (${rows}×${columns})`;
}

/** What a region is called: its number, and its name or place. */
export function titleOf(region: Region): string {
  return `${region.number} · ${region.name || wordsOf(region)}`;
}

/** The part of a region that a press at `(x, y)` takes hold of: its edges, or the whole. */
export interface Grip {
  region: Region;
  top: boolean;
  bottom: boolean;
  left: boolean;
  right: boolean;
}

/** What is held at a place in pixels of the video; `slack` is how far an edge reaches. */
export function gripAt(regions: Region[], x: number, y: number, slack: number): Grip | null {
  for (const region of [...regions].reverse()) {
    const [dx, dy] = [Math.min(slack, region.columns / 4), Math.min(slack, region.rows / 4)];
    const [right, bottom] = [region.x + region.columns, region.y + region.rows];
    if (x < region.x - slack / 2 || x > right + slack / 2 || y < region.y - slack / 2 || y > bottom + slack / 2) continue;
    return { region, top: y < region.y + dy, bottom: y > bottom - dy, left: x < region.x + dx, right: x > right - dx };
  }
  return null;
}

/** The rectangle of a grip that was moved by whole pixels. */
export function dragged({ region, top, bottom, left, right }: Grip, byX: number, byY: number): Rect {
  if (!top && !bottom && !left && !right) {
    return { y: region.y + byY, x: region.x + byX, rows: region.rows, columns: region.columns };
  }
  const [y1, x1] = [region.y + region.rows, region.x + region.columns];
  const y0 = top ? Math.min(region.y + byY, y1 - 1) : region.y;
  const x0 = left ? Math.min(region.x + byX, x1 - 1) : region.x;
  return {
    y: y0,
    x: x0,
    rows: Math.max(1, bottom ? y1 + byY - y0 : y1 - y0),
    columns: Math.max(1, right ? x1 + byX - x0 : x1 - x0),
  };
}
