/** Reports this page as a viewer while it is visible, and reads the other viewers. */
import type { Watcher } from "../../../shared/api/types";
import { signal, type ReadonlySignal } from "@preact/signals-core";
import type { Api } from "../../../shared/api/client";

const REFRESH_MS = 10_000;
/** Bounds for the interval that the server requests [ms]. */
const BOUNDS_MS = [2_000, 60_000] as const;

export class Watchers {
  readonly #api: Api;
  readonly #id: string;
  readonly #others = signal<readonly Watcher[] | null>(null);
  #timer: ReturnType<typeof setTimeout> | undefined;
  #visible = false;

  /** The other viewers; `null`: unknown. */
  readonly others: ReadonlySignal<readonly Watcher[] | null> = this.#others;

  constructor(api: Api, id: string) {
    this.#api = api;
    this.#id = id;
  }

  /** Starts or ends the reports when the page becomes visible or hidden. */
  setVisible(visible: boolean): void {
    if (visible === this.#visible) return;
    this.#visible = visible;
    clearTimeout(this.#timer);
    if (visible) void this.#report();
    else void this.#api.unwatch(this.#id).catch(() => undefined); // The server removes it after a timeout.
  }

  async #report(): Promise<void> {
    let delayMs = REFRESH_MS;
    try {
      const { items, refresh_ms: refreshMs } = await this.#api.watch(this.#id);
      if (!this.#visible) return;
      this.#others.value = items;
      delayMs = Math.min(BOUNDS_MS[1], Math.max(BOUNDS_MS[0], refreshMs));
    } catch {
      this.#others.value = null;
    }
    if (this.#visible) this.#timer = setTimeout(() => void this.#report(), delayMs);
  }
}
