/** The account's audit log, read page by page. */
import { signal, type ReadonlySignal } from "@preact/signals-core";
import type { Api } from "../../../shared/api/client";
import { sentence } from "../../../shared/api/http";
import type { AuditQuery, AuditRecord } from "../../../shared/api/sharing";

const PAGE = 50;
/** A strict filter can return empty pages: this many are read before the user must continue. */
const MAX_PAGES_PER_LOAD = 5;

export const ALL_ENTRIES: AuditQuery = { event: "", target: "", sinceMs: null, untilMs: null };

export class AuditReader {
  readonly #api: Api;
  readonly #records = signal<readonly AuditRecord[]>([]);
  readonly #busy = signal(false);
  readonly #error = signal("");
  readonly #more = signal(true);
  #query = ALL_ENTRIES;
  #cursor: string | null = null;
  #generation = 0;

  /** The newest first. */
  readonly records: ReadonlySignal<readonly AuditRecord[]> = this.#records;
  readonly busy: ReadonlySignal<boolean> = this.#busy;
  readonly error: ReadonlySignal<string> = this.#error;
  /** Whether older entries may exist. */
  readonly more: ReadonlySignal<boolean> = this.#more;

  constructor(api: Api) {
    this.#api = api;
  }

  /** Restarts with another filter. */
  load(query: AuditQuery): Promise<void> {
    this.#query = query;
    this.#cursor = null;
    this.#records.value = [];
    this.#more.value = true;
    return this.loadOlder();
  }

  /** Reads the next page. Entries already read stay after an error. */
  async loadOlder(): Promise<void> {
    const generation = ++this.#generation;
    this.#busy.value = true;
    this.#error.value = "";
    try {
      for (let page = 0; page < MAX_PAGES_PER_LOAD; page += 1) {
        const { items, cursor } = await this.#api.audit(this.#query, this.#cursor, PAGE);
        if (generation !== this.#generation) return; // Another filter was chosen meanwhile.
        this.#cursor = cursor;
        this.#records.value = [...this.#records.value, ...items];
        this.#more.value = cursor !== null;
        if (cursor === null || items.length > 0) break;
      }
    } catch (error) {
      if (generation === this.#generation) this.#error.value = sentence(error);
    }
    if (generation === this.#generation) this.#busy.value = false;
  }
}

/** Account names that occur in these records. */
export function accountNamesOf(records: readonly AuditRecord[]): ReadonlyMap<string, string> {
  const names = new Map<string, string>();
  for (const { account: id, actor, key, data } of records) {
    // For an API key, the name includes the key's name.
    if (id !== "" && actor !== "" && key === "") names.set(id, actor);
    const { with: other, name } = data;
    if (typeof other === "string" && typeof name === "string" && name !== "") names.set(other, name);
  }
  return names;
}

/** The subject of a record: `device:abc-arm` → `["device", "abc-arm"]`; the kind is empty if not given. */
export function subjectOf(target: string): [kind: string, id: string] {
  const match = /^(device|space|agent|key):(.+)$/.exec(target);
  return match?.[1] === undefined || match[2] === undefined ? ["", target] : [match[1], match[2]];
}
