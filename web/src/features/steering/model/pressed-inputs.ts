/**
 * The currently pressed buttons, sticks, keys and gamepads, each by name. The end of a stream spends all pressed inputs:
 * a spent input has no effect until it is released and pressed again.
 */
export class PressedInputs<T> {
  readonly #parts = new Map<string, T>();
  readonly #spent = new Set<string>();
  readonly #tell: (parts: readonly T[]) => void;

  /** `tell`: called after every change; an empty list means that no input is pressed. */
  constructor(tell: (parts: readonly T[]) => void) {
    this.#tell = tell;
  }

  /** A new press. */
  press(name: string, part: T): void {
    this.#spent.delete(name);
    this.keep(name, part);
  }

  /** Updates a pressed input, for example a moved stick. */
  keep(name: string, part: T): void {
    if (this.#spent.has(name)) return;
    this.#parts.set(name, part);
    this.again();
  }

  release(name: string): void {
    this.#spent.delete(name);
    if (this.#parts.delete(name)) this.again();
  }

  /** Spends all pressed inputs after the end of a stream. */
  spend(): void {
    for (const name of this.#parts.keys()) this.#spent.add(name);
    this.#parts.clear();
  }

  releaseAll(): void {
    if (this.#parts.size === 0) return;
    this.spend();
    this.again();
  }

  /** Calls `tell` again, because the meaning of the inputs changed. */
  again(): void {
    this.#tell([...this.#parts.values()]);
  }

  get any(): boolean {
    return this.#parts.size > 0;
  }
}
