// What the result rests on: frame, PSF, residual, course and verdict.

import { Chart } from "./chart";
import { css, fit, h } from "./dom";
import { number } from "./format";
import { ExcludedOverlay } from "./masks";
import { Bitmap } from "./picture";
import type { Store } from "./store";
import type { HistoryPoint, Meta, Picture } from "./types";

export class Evidence {
  readonly element: HTMLElement;
  private readonly redraw: (() => void)[] = [];

  constructor(private readonly store: Store) {
    this.element = h("div", { class: "evidence" });
    store.source.results.forEach((meta, at) => this.add(meta, at));
    store.on((what) => {
      if (what === "time") for (const draw of this.redraw) draw();
    });
  }

  /** Draws what was hidden so far. */
  draw(): void {
    for (const draw of this.redraw) draw();
  }

  private add(meta: Meta, at: number): void {
    const { view } = meta;
    const several = this.store.source.results.length > 1;
    if (several) this.element.append(h("h3", {}, meta.name));
    if (!view?.settings) {
      this.element.append(
        h("p", { class: "muted" }, "Only the video is available: this is a single video, or a folder written by an earlier version."),
      );
      return;
    }
    if (view.fit) {
      const good = view.fit.verdict === "good";
      const reason = view.fit.reason;
      this.element.append(
        h(
          "p",
          { class: good ? "verdict" : "verdict doubtful", role: "note" },
          h("strong", {}, `Fit: ${view.fit.verdict}. `),
          `${reason.charAt(0).toUpperCase()}${reason.slice(1)}.`,
        ),
      );
    }
    const grid = h("div", { class: "pictures" });
    const excluded = this.excluded(at);
    if (excluded) this.element.append(excluded.legend);
    this.element.append(grid);
    this.picture(
      grid,
      at,
      "frame",
      "Captured frame in counts, white the brightest; the rows that measure this bin are marked",
      (p) => this.drawFrame(p, meta),
      excluded,
    );
    this.picture(grid, at, "psf", "PSF, square root of each pixel's share of the light", (p) => {
      const root = p.data.map(Math.sqrt);
      const bitmap = new Bitmap(p.rows, p.columns);
      bitmap.values(root, "magma", 0, highest(root));
      return (ctx, w, hgt) => ctx.drawImage(bitmap.canvas, 0, 0, w, hgt);
    });
    const drawResidual = (p: Picture) => {
      const bitmap = new Bitmap(p.rows, p.columns);
      bitmap.signed((i) => p.data[i], 4);
      this.statistics(grid, p);
      return (ctx: CanvasRenderingContext2D, w: number, hgt: number) => ctx.drawImage(bitmap.canvas, 0, 0, w, hgt);
    };
    this.picture(
      grid,
      at,
      "residual",
      "Residual in σ, blue −4 to red +4: structureless where the fit is good",
      drawResidual,
      excluded,
    );
    this.picture(grid, at, "direct", "The scene without the diffuser, in counts, white the brightest", (p) => {
      const bitmap = new Bitmap(p.rows, p.columns);
      bitmap.values(p.data, "grey", 0, highest(p.data));
      return (ctx, w, hgt) => ctx.drawImage(bitmap.canvas, 0, 0, w, hgt);
    });
    if (view.course && view.course.length > 1) this.element.append(convergenceFigure(view.course));
  }

  /** The pixels that were left out of the frame; null where there is no mask. */
  private excluded(at: number): ExcludedOverlay | null {
    const { source } = this.store;
    if (!source.results[at].images.excluded) return null;
    const overlay = new ExcludedOverlay(`over-excluded-${at}`, () => this.draw());
    void source.picture(at, "excluded").then((mask) => mask && overlay.set(mask));
    return overlay;
  }

  private picture(
    grid: HTMLElement,
    at: number,
    name: string,
    caption: string,
    prepare: (picture: Picture) => (ctx: CanvasRenderingContext2D, width: number, height: number) => void,
    overlay: ExcludedOverlay | null = null,
  ): void {
    const size = this.store.source.results[at].images[name];
    if (!size) return;
    const canvas = h("canvas", { role: "img", "aria-label": caption, "data-picture": name });
    canvas.style.aspectRatio = `${size[1]} / ${size[0]}`;
    grid.append(h("figure", {}, canvas, h("figcaption", {}, caption)));
    void this.store.source.picture(at, name).then((picture) => {
      if (!picture) return;
      const paint = prepare(picture);
      const draw = () => {
        if (canvas.offsetParent === null) return;
        const { ctx, width, height } = fit(canvas);
        ctx.imageSmoothingEnabled = false;
        paint(ctx, width, height);
        overlay?.drawOn(ctx, width, height);
      };
      this.redraw.push(draw);
      new ResizeObserver(draw).observe(canvas);
      draw();
    });
  }

  private drawFrame(picture: Picture, meta: Meta): (ctx: CanvasRenderingContext2D, width: number, height: number) => void {
    const bitmap = new Bitmap(picture.rows, picture.columns);
    bitmap.values(picture.data, "grey", 0, highest(picture.data));
    const rows = meta.view?.row_bins ?? [];
    return (ctx, width, height) => {
      ctx.drawImage(bitmap.canvas, 0, 0, width, height);
      const { t } = this.store.state;
      const tall = height / picture.rows;
      ctx.fillStyle = css("--accent");
      rows.forEach(([first, last], r) => {
        if (t < first || t > last) return;
        ctx.globalAlpha = 0.45;
        ctx.fillRect(0, r * tall, width, tall);
        ctx.globalAlpha = 1;
        ctx.fillRect(0, r * tall, 5, Math.max(2, tall));
        ctx.fillRect(width - 5, r * tall, 5, Math.max(2, tall));
      });
    };
  }

  /** Distribution of the residual beside that of pure noise. */
  private statistics(grid: HTMLElement, { data }: Picture): void {
    const BARS = 41;
    const counts = new Float64Array(BARS);
    let [sum, squares, n] = [0, 0, 0];
    for (const v of data) {
      // Pixels that were left out are exactly 0.
      if (!Number.isFinite(v) || v === 0) continue;
      counts[Math.min(BARS - 1, Math.max(0, Math.floor(((v + 5) / 10) * BARS)))]++;
      sum += v;
      squares += v * v;
      n++;
    }
    const mean = sum / n;
    const rms = Math.sqrt(squares / n);
    const canvas = h("canvas", { role: "img", "aria-label": `Histogram of the residual, rms ${number(rms, 3)} σ` });
    canvas.style.aspectRatio = "4 / 3";
    const draw = () => {
      if (canvas.offsetParent === null) return;
      const { ctx, width, height } = fit(canvas);
      ctx.clearRect(0, 0, width, height);
      const normal = (v: number) => (n * (10 / BARS) * Math.exp((-v * v) / 2)) / Math.sqrt(2 * Math.PI);
      const most = Math.max(normal(0), ...counts);
      const base = height - 18;
      const y = (c: number) => base - (c / most) * (base - 6);
      ctx.fillStyle = css("--accent-soft");
      for (let i = 0; i < BARS; i++) ctx.fillRect((i * width) / BARS + 0.5, y(counts[i]), width / BARS - 1, base - y(counts[i]));
      ctx.beginPath();
      for (let i = 0; i <= 100; i++) ctx.lineTo((i / 100) * width, y(normal(-5 + i / 10)));
      ctx.strokeStyle = css("--ink");
      ctx.lineWidth = 1.25;
      ctx.stroke();
      ctx.fillStyle = css("--muted");
      ctx.font = "11px system-ui, sans-serif";
      ctx.textAlign = "center";
      for (const v of [-4, -2, 0, 2, 4]) ctx.fillText(`${v < 0 ? "−" : ""}${Math.abs(v)}σ`, ((v + 5) / 10) * width, height - 4);
    };
    grid.append(
      h("figure", {}, canvas, h("figcaption", {}, `Its distribution: rms ${number(rms, 3)}, mean ${number(mean, 2)}; the line is Gaussian noise`)),
    );
    this.redraw.push(draw);
    new ResizeObserver(draw).observe(canvas);
  }
}

/** Residual, and PSNR where the truth is known, over time. */
export function convergenceFigure(points: HistoryPoint[]): HTMLElement {
  const chart = new Chart({
    label: "Convergence",
    x: "time (s)",
    y: "residual/σ",
    right: points.some((p) => p.psnr_db != null) ? "PSNR (dB)" : "",
    height: 220,
    log: true,
  });
  drawConvergence(chart, points);
  return h("figure", { class: "wide" }, h("figcaption", {}, "Convergence; dashed: PSNR, where the truth is known"), chart.element);
}

export function drawConvergence(chart: Chart, points: HistoryPoint[]): void {
  const x = points.map((p) => p.seconds);
  const curves = [{ label: "residual/σ", colour: css("--accent"), x, y: points.map((p) => p.residual_over_sigma) }];
  const psnr = points.map((p) => p.psnr_db);
  chart.set(
    psnr.some((v) => v != null)
      ? [...curves, { label: "PSNR", colour: css("--muted"), x, y: psnr, right: true, dash: [5, 3] }]
      : curves,
  );
}

function highest(data: ArrayLike<number>): number {
  // All but a thousandth: a hot pixel does not darken the rest.
  const finite = Array.from(data as ArrayLike<number>).filter(Number.isFinite).sort((a, b) => a - b);
  return finite[Math.floor(0.999 * (finite.length - 1))] || 1;
}

/** All numbers, the command and the files. */
export function settings(store: Store): HTMLElement {
  const element = h("div", { class: "settings" });
  store.source.results.forEach((meta, at) => {
    const { view } = meta;
    if (store.source.results.length > 1) element.append(h("h3", {}, meta.name));
    for (const warning of view?.warnings ?? []) {
      element.append(h("p", { class: "verdict doubtful", role: "note" }, h("strong", {}, "Warning: "), warning));
    }
    for (const [section, rows] of view?.settings ?? []) {
      element.append(
        h(
          "table",
          {},
          h("caption", {}, section),
          h("tbody", {}, ...rows.map(([name, value]) => h("tr", {}, h("th", { scope: "row" }, name), h("td", {}, value)))),
        ),
      );
    }
    if (view?.command) element.append(h("p", {}, "To repeat it:"), h("pre", {}, h("code", {}, view.command)));
    const links = meta.files.map((name) => {
      const url = store.source.fileUrl(at, name);
      return url ? h("a", { href: url, download: name }, name) : null;
    });
    if (links.some(Boolean)) element.append(h("p", { class: "files" }, "Files: ", ...links));
    if (!view?.settings && !view?.command) element.append(h("p", { class: "muted" }, `${meta.shape.join(" × ")} [t, y, x]`));
  });
  return element;
}
