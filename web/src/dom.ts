// Elements without markup in strings.

type Child = Node | string | null | undefined | false;
type Attributes = Record<string, string | number | boolean | null | undefined | ((event: never) => void)>;

/** An element; a function is a listener, `true` an attribute without a value. */
export function h<K extends keyof HTMLElementTagNameMap>(
  tag: K,
  attributes: Attributes = {},
  ...children: Child[]
): HTMLElementTagNameMap[K] {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (typeof value === "function") element.addEventListener(name, value as EventListener);
    else if (value === true) element.setAttribute(name, "");
    else if (value !== false && value != null) element.setAttribute(name, String(value));
  }
  element.append(...children.filter((c): c is Node | string => c != null && c !== false));
  return element;
}

/** A select box with a label beside it. */
export function choice<T extends string>(
  label: string,
  options: [T, string][],
  value: T,
  onChange: (value: T) => void,
  id: string,
): HTMLLabelElement {
  const select = h(
    "select",
    { id, change: () => onChange(select.value as T) },
    ...options.map(([name, text]) => h("option", { value: name, selected: name === value }, text)),
  );
  return h("label", { class: "choice" }, h("span", {}, label), select);
}

/** A canvas's context, its bitmap as fine as the screen; returns its size in CSS pixels. */
export function fit(canvas: HTMLCanvasElement): { ctx: CanvasRenderingContext2D; width: number; height: number } {
  const ratio = window.devicePixelRatio || 1;
  const width = canvas.clientWidth;
  const height = canvas.clientHeight;
  const [w, hgt] = [Math.max(1, Math.round(width * ratio)), Math.max(1, Math.round(height * ratio))];
  if (canvas.width !== w || canvas.height !== hgt) {
    canvas.width = w;
    canvas.height = hgt;
  }
  const ctx = canvas.getContext("2d")!;
  ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
  return { ctx, width, height };
}

/** A colour of the style sheet. */
export function css(name: string): string {
  return getComputedStyle(document.getElementById("rowburst")!).getPropertyValue(name).trim();
}

/** Gives the browser a file to keep. */
export function download(name: string, content: Blob): void {
  const url = URL.createObjectURL(content);
  const link = h("a", { href: url, download: name });
  document.body.append(link);
  link.click();
  link.remove();
  setTimeout(() => URL.revokeObjectURL(url), 10_000);
}

/** How long a notice stands. */
const NOTICE_MS = 8000;
let noticeEnds: ReturnType<typeof setTimeout> | undefined;

/** Tells the user something that is read out and goes away again. */
export function notify(text: string): void {
  const place = document.getElementById("rowburst-notice");
  if (!place) return;
  place.textContent = text;
  place.hidden = false;
  clearTimeout(noticeEnds);
  noticeEnds = setTimeout(() => (place.hidden = true), NOTICE_MS);
}

/** Text to be read out, without a change to be seen. */
export function announce(text: string): void {
  const place = document.getElementById("rowburst-status");
  if (place && place.textContent !== text) place.textContent = text;
}
