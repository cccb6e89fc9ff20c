/** The sessions of a device, read page by page. */
import { signal, type ReadonlySignal } from "@preact/signals-core";
import type { Api } from "../../../shared/api/client";
import type { StoredSession } from "../../../shared/api/autonomy";
import { sentence } from "../../../shared/api/http";

const PAGE = 20;

export class SessionHistory {
  readonly #api: Api;
  readonly #device: string;
  readonly #sessions = signal<readonly StoredSession[] | null>(null);
  readonly #busy = signal(false);
  readonly #error = signal("");
  readonly #more = signal(false);
  #cursor: string | null = null;
  /** Each call replaces the previous one: a late response of an earlier call is ignored. */
  #call = 0;

  /** Newest first; null before the first response. */
  readonly sessions: ReadonlySignal<readonly StoredSession[] | null> = this.#sessions;
  /** Whether older sessions are being loaded. */
  readonly busy: ReadonlySignal<boolean> = this.#busy;
  readonly error: ReadonlySignal<string> = this.#error;
  /** Whether older sessions exist. */
  readonly more: ReadonlySignal<boolean> = this.#more;

  constructor(api: Api, device: string) {
    this.#api = api;
    this.#device = device;
  }

  /** Reads the newest page. Older sessions stay, unless more new ones have started than one page contains. */
  async refresh(): Promise<void> {
    if (this.#busy.value) return;
    await this.#read(null, ({ items, cursor }) => {
      const known = this.#sessions.value ?? [];
      const last = items.at(-1)?.epoch;
      const joins = last !== undefined && known.some(({ epoch }) => epoch === last);
      const older = joins ? known.filter(({ epoch }) => epoch < last) : [];
      this.#sessions.value = [...items, ...older];
      if (older.length === 0) this.#cursor = cursor;
    });
  }

  /** Appends the next page. Sessions that were read already stay after an error. */
  async loadOlder(): Promise<void> {
    this.#busy.value = true;
    await this.#read(this.#cursor, ({ items, cursor }) => {
      this.#sessions.value = [...(this.#sessions.value ?? []), ...items];
      this.#cursor = cursor;
    });
    this.#busy.value = false;
  }

  async #read(cursor: string | null, apply: (page: { items: StoredSession[]; cursor: string | null }) => void): Promise<void> {
    const call = ++this.#call;
    try {
      const page = await this.#api.autonomy.sessions(this.#device, cursor, PAGE);
      if (call !== this.#call) return;
      apply(page);
      this.#more.value = this.#cursor !== null;
      this.#error.value = "";
    } catch (error) {
      if (call === this.#call) this.#error.value = sentence(error);
    }
  }
}
