/** Reports this page as a viewer while it is visible, and reads the other viewers. */
import type { Watcher } from "../../../shared/api/types";
import { signal, type ReadonlySignal } from "@preact/signals-core";
import type { Api } from "../../../shared/api/client";

const AGAIN_MS = 10_000;
/** Bounds for the interval that the server requests [ms]. */
const BOUNDS_MS = [2_000, 60_000] as const;

export class Watchers {
  readonly #api: Api;
  readonly #id: string;
  readonly #others = signal<readonly Watcher[] | null>(null);
  #timer: ReturnType<typeof setTimeout> | undefined;
  #on = false;

  /** The other viewers; `null`: unknown. */
  readonly others: ReadonlySignal<readonly Watcher[] | null> = this.#others;

  constructor(api: Api, id: string) {
    this.#api = api;
    this.#id = id;
  }

  /** The page became visible or hidden. */
  seen(visible: boolean): void {
    if (visible === this.#on) return;
    this.#on = visible;
    clearTimeout(this.#timer);
    if (visible) void this.#say();
    else void this.#api.unwatch(this.#id).catch(() => undefined); // Its time runs out by itself.
  }

  async #say(): Promise<void> {
    let inMs = AGAIN_MS;
    try {
      const { items, refresh_ms: wanted } = await this.#api.watch(this.#id);
      if (!this.#on) return;
      this.#others.value = items;
      inMs = Math.min(BOUNDS_MS[1], Math.max(BOUNDS_MS[0], wanted));
    } catch {
      this.#others.value = null;
    }
    if (this.#on) this.#timer = setTimeout(() => void this.#say(), inMs);
  }
}
