// Charts by uPlot, in the colours of the page.

import uPlot from "uplot";
import { css, h } from "./dom";
import { number } from "./format";

export interface Curve {
  label: string;
  colour: string;
  x: ArrayLike<number>;
  y: ArrayLike<number | null>;
  dash?: number[];
  width?: number;
  points?: boolean;
  /** Half the height of the band about it. */
  error?: ArrayLike<number | null>;
  /** Second scale, on the right. */
  right?: boolean;
}

export interface ChartOptions {
  label: string;
  x: string;
  y: string;
  right?: string;
  height: number;
  log?: boolean;
  /** A place on the x axis was chosen. */
  onPick?: (x: number) => void;
  /** Where the mark stands. */
  mark?: () => number | null;
}

export class Chart {
  readonly element: HTMLElement;
  private plot: uPlot | null = null;
  private curves: Curve[] = [];

  constructor(private readonly options: ChartOptions) {
    this.element = h("div", { class: "chart", role: "img", "aria-label": options.label });
    new ResizeObserver(() => {
      const width = this.element.clientWidth;
      if (this.plot && width > 0) this.plot.setSize({ width, height: options.height });
      else if (width > 0) this.draw();
    }).observe(this.element);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
  }

  set(curves: Curve[]): void {
    this.curves = curves;
    this.draw();
  }

  /** Draws the mark anew. */
  mark(): void {
    this.plot?.redraw(false);
  }

  private draw(): void {
    this.plot?.destroy();
    this.plot = null;
    const width = this.element.clientWidth;
    if (width === 0 || this.curves.length === 0) return;
    const { options } = this;
    const [ink, grid] = [css("--muted"), css("--grid")];
    const series: uPlot.Series[] = [{}];
    const bands: uPlot.Band[] = [];
    const tables: uPlot.AlignedData[] = [];
    for (const curve of this.curves) {
      const x = Array.from(curve.x);
      const y = Array.from(curve.y, (v) => (v == null || !Number.isFinite(v) ? null : v));
      tables.push([x, y] as uPlot.AlignedData);
      const scale = curve.right ? "right" : "y";
      series.push({
        label: curve.label,
        stroke: curve.colour,
        width: curve.width ?? 1.75,
        scale,
        spanGaps: true,
        ...(curve.dash ? { dash: curve.dash } : {}),
        points: { show: curve.points === true, size: 4, fill: curve.colour },
      });
      if (curve.error) {
        const edge = (sign: number) =>
          y.map((v, i) => {
            const e = curve.error![i];
            return v == null || e == null || !Number.isFinite(e) ? null : v + sign * e;
          });
        for (const sign of [1, -1]) {
          tables.push([x, edge(sign)] as uPlot.AlignedData);
          series.push({ label: `${curve.label} ${sign > 0 ? "+" : "−"}`, stroke: "transparent", width: 0, scale, spanGaps: true, points: { show: false } });
        }
        bands.push({ series: [series.length - 2, series.length - 1], fill: `${curve.colour}38` });
      }
    }
    const axis = (label: string, more: Partial<uPlot.Axis> = {}): uPlot.Axis => ({
      label,
      stroke: ink,
      labelFont: "12px system-ui, sans-serif",
      font: "11px system-ui, sans-serif",
      labelSize: 18,
      grid: { stroke: grid, width: 1 },
      ticks: { stroke: grid, width: 1, size: 4 },
      ...more,
    });
    const values: uPlot.Axis.DynamicValues = (_, ticks) => ticks.map((v) => (v == null ? "" : number(v, 4)));
    this.plot = new uPlot(
      {
        width,
        height: options.height,
        legend: { show: false },
        cursor: { y: false, drag: { x: false, y: false } },
        scales: { x: { time: false }, y: { distr: options.log ? 3 : 1 } },
        axes: [
          axis(options.x, { size: 34, values }),
          axis(options.y, { size: 52, values }),
          ...(options.right ? [axis(options.right, { side: 1, scale: "right", size: 46, grid: { show: false }, values })] : []),
        ],
        series,
        bands,
        hooks: { draw: [(plot) => this.drawMark(plot)] },
      },
      tables.length === 1 ? tables[0] : uPlot.join(tables),
      this.element,
    );
    if (options.onPick) {
      const { plot } = this;
      plot.over.addEventListener("click", (event) => {
        options.onPick!(plot.posToVal(event.offsetX, "x"));
      });
    }
  }

  private drawMark(plot: uPlot): void {
    const at = this.options.mark?.();
    if (at == null) return;
    const x = Math.round(plot.valToPos(at, "x", true));
    const { left, top, width, height } = plot.bbox;
    if (x < left || x > left + width) return;
    plot.ctx.fillStyle = css("--accent");
    plot.ctx.fillRect(x - 1, top, 2, height);
  }
}
