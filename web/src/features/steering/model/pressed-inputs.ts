/**
 * What hands hold at one moment, on pads, sticks, keys and gamepads, each under a name of its own. Whatever ends a
 * stream spends what is held then: it counts for nothing until it has been let go and is pressed anew.
 */
export class PressedInputs<T> {
  readonly #parts = new Map<string, T>();
  readonly #spent = new Set<string>();
  readonly #tell: (parts: readonly T[]) => void;

  /** `tell`: hears of every change; nothing is held where the list is empty. */
  constructor(tell: (parts: readonly T[]) => void) {
    this.#tell = tell;
  }

  /** A new press. */
  press(name: string, part: T): void {
    this.#spent.delete(name);
    this.keep(name, part);
  }

  /** It is held still, perhaps elsewhere. */
  keep(name: string, part: T): void {
    if (this.#spent.has(name)) return;
    this.#parts.set(name, part);
    this.again();
  }

  release(name: string): void {
    this.#spent.delete(name);
    if (this.#parts.delete(name)) this.again();
  }

  /** The stream has ended. */
  spend(): void {
    for (const name of this.#parts.keys()) this.#spent.add(name);
    this.#parts.clear();
  }

  releaseAll(): void {
    if (this.#parts.size === 0) return;
    this.spend();
    this.again();
  }

  /** Say it again: what it means has changed. */
  again(): void {
    this.#tell([...this.#parts.values()]);
  }

  get any(): boolean {
    return this.#parts.size > 0;
  }
}
