/** A value with undo and redo. */
import { batch, computed, signal, type ReadonlySignal } from "@preact/signals-core";

const MAX_STEPS = 200;

export class UndoHistory<T> {
  readonly #now;
  readonly #before = signal<readonly T[]>([]);
  readonly #after = signal<readonly T[]>([]);
  #gesture = "";

  readonly now: ReadonlySignal<T>;
  readonly canUndo = computed(() => this.#before.value.length > 0);
  readonly canRedo = computed(() => this.#after.value.length > 0);

  constructor(first: T) {
    this.#now = signal(first);
    this.now = this.#now;
  }

  /** Records a change. Consecutive changes of one `gesture` (a slider drag) are one step. */
  change(next: T, gesture = ""): void {
    if (Object.is(next, this.#now.value)) return;
    const continues = gesture !== "" && gesture === this.#gesture;
    this.#gesture = gesture;
    batch(() => {
      if (!continues) this.#before.value = [...this.#before.value, this.#now.value].slice(-MAX_STEPS);
      this.#after.value = [];
      this.#now.value = next;
    });
  }

  /** Ends the gesture; the next change is a new step. */
  endGesture(): void {
    this.#gesture = "";
  }

  undo(): void {
    this.#step(this.#before, this.#after);
  }

  redo(): void {
    this.#step(this.#after, this.#before);
  }

  #step(from: { value: readonly T[] }, to: { value: readonly T[] }): void {
    const found = from.value.at(-1);
    if (found === undefined) return;
    this.#gesture = "";
    batch(() => {
      to.value = [...to.value, this.#now.value];
      from.value = from.value.slice(0, -1);
      this.#now.value = found;
    });
  }
}
