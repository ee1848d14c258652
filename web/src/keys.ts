// The keys of the page: one table gives what they do and what the help says of them.

/** A row of the table. */
interface Binding {
  group: string;
  /** As the help shows them. */
  label: string;
  text: string;
}

const ARROWS = /^(Arrow|Home|End|Page)/;

/** Whether the element that has the focus needs the key itself. */
function isTaken(target: HTMLElement, key: string): boolean {
  const input = target.closest("input");
  // A slider needs its arrows, but no letters and no space.
  if (input?.type === "range") return ARROWS.test(key);
  if (target.closest("input, select, textarea, summary, dialog")) return true;
  if (target.closest("[role=tab]") && key.startsWith("Arrow")) return true;
  return key === " " && target.closest("button, a") !== null;
}

export class Keys {
  readonly bindings: Binding[] = [];
  private readonly acts = new Map<string, (event: KeyboardEvent) => void>();

  /** `keys` as events name them, letters in lower case. */
  add(group: string, label: string, text: string, keys: Record<string, (event: KeyboardEvent) => void>): void {
    this.bindings.push({ group, label, text });
    for (const [key, act] of Object.entries(keys)) {
      if (this.acts.has(key)) throw new Error(`The key ${key} has two meanings.`);
      this.acts.set(key, act);
    }
  }

  /** Keys that an element handles while it has the focus: for the help alone. */
  note(group: string, label: string, text: string): void {
    this.bindings.push({ group, label, text });
  }

  listen(): void {
    document.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey || event.defaultPrevented) return;
      if (isTaken(event.target as HTMLElement, event.key)) return;
      const act = this.acts.get(event.key.length === 1 ? event.key.toLowerCase() : event.key);
      if (!act) return;
      event.preventDefault();
      act(event);
    });
  }
}
