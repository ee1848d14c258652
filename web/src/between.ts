// How far two results are from each other.

import { h } from "./dom";
import { number } from "./format";
import type { Store } from "./store";
import { yieldToBrowser, type Volume } from "./volume";

/** Peak signal-to-noise ratio in dB, with `truth` and its maximum for reference; null where they are equal or nothing is lit. */
export async function psnr(video: Volume, truth: Volume): Promise<number | null> {
  let [sum, count, peak] = [0, 0, -Infinity];
  for (let t = 0; t < video.bins; t++) {
    const [a, b] = [video.bin(t), truth.bin(t)];
    for (let i = 0; i < a.length; i++) {
      if (a[i] === video.missing || b[i] === truth.missing) continue;
      const wanted = truth.low + b[i] * truth.step;
      const difference = video.low + a[i] * video.step - wanted;
      sum += difference * difference;
      count++;
      if (wanted > peak) peak = wanted;
    }
    if (t % 8 === 7) await yieldToBrowser();
  }
  return sum > 0 && peak > 0 ? 10 * Math.log10((peak * peak * count) / sum) : null;
}

/** A line that says it, once both videos are there; none where they have not the same shape. */
export function between(store: Store): HTMLElement | null {
  const { video, other } = store;
  const [first, second] = store.source.results;
  if (!other || !second || [0, 1, 2].some((i) => first.shape[i] !== second.shape[i])) return null;
  const line = h("p", { class: "muted note", id: "between", hidden: true });
  let begun = false;
  store.on((what) => {
    if (what !== "data" || begun || !video.isWhole || !other.isWhole) return;
    begun = true;
    if (store.otherRatio !== 1) {
      line.textContent = `${first.name} and ${second.name} have other units: no PSNR of the one against the other.`;
      line.hidden = false;
      return;
    }
    void psnr(video, other).then((db) => {
      const words = db == null ? "they are equal, or zero everywhere" : `${number(db, 4)} dB, with its maximum as peak`;
      line.textContent = `PSNR of ${first.name} against ${second.name}: ${words}`;
      line.hidden = false;
    });
  });
  return line;
}
