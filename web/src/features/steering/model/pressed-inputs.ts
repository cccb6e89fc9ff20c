/**
 * The currently pressed buttons, sticks, keys and gamepads, each by name. The end of a stream spends all pressed inputs:
 * a spent input has no effect until it is released and pressed again.
 */
export class PressedInputs<T> {
  readonly #parts = new Map<string, T>();
  readonly #spent = new Set<string>();
  readonly #onChange: (parts: readonly T[]) => void;
  readonly #onPress: () => void;

  /**
   * `onChange`: called after every change; an empty list means that no input is pressed. `onPress`: called before it for a new
   * press.
   */
  constructor(onChange: (parts: readonly T[]) => void, onPress: () => void = () => undefined) {
    this.#onChange = onChange;
    this.#onPress = onPress;
  }

  /** A new press. */
  press(name: string, part: T): void {
    this.#spent.delete(name);
    this.#onPress();
    this.update(name, part);
  }

  /** Updates a pressed input, for example a moved stick. */
  update(name: string, part: T): void {
    if (this.#spent.has(name)) return;
    this.#parts.set(name, part);
    this.notify();
  }

  release(name: string): void {
    this.#spent.delete(name);
    if (this.#parts.delete(name)) this.notify();
  }

  /** Spends all pressed inputs after the end of a stream. */
  spend(): void {
    for (const name of this.#parts.keys()) this.#spent.add(name);
    this.#parts.clear();
  }

  releaseAll(): void {
    if (this.#parts.size === 0) return;
    this.spend();
    this.notify();
  }

  /** Calls `onChange` again after the meaning of the inputs changed. */
  notify(): void {
    this.#onChange([...this.#parts.values()]);
  }

  get any(): boolean {
    return this.#parts.size > 0;
  }
}
