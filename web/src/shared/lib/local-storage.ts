/** Per-account data in this browser: unsaved text and last used values. */

/** The interface of `localStorage`. If it is unavailable or full, values are not stored and no error occurs. */
type Store = Pick<Storage, "getItem" | "setItem" | "removeItem">;

export class StoredValue<T> {
  readonly #store: Store | null;
  readonly #key: string;
  readonly #isValid: (value: unknown) => value is T;

  /** `fits`: validates a stored value, which another version of the page may have written. */
  constructor(store: Store | null, key: string, isValid: (value: unknown) => value is T) {
    this.#store = store;
    this.#key = `telescope.${key}`;
    this.#isValid = isValid;
  }

  read(): T | null {
    try {
      const value: unknown = JSON.parse(this.#store?.getItem(this.#key) ?? "null");
      return this.#isValid(value) ? value : null;
    } catch {
      return null;
    }
  }

  /** Whether the value was stored. */
  write(value: T): boolean {
    try {
      this.#store?.setItem(this.#key, JSON.stringify(value));
      return this.#store !== null;
    } catch {
      return false;
    }
  }

  remove(): void {
    try {
      this.#store?.removeItem(this.#key);
    } catch {
      // Unavailable storage holds no value.
    }
  }
}

/** Unsaved text of a movement. */
export interface Draft {
  source: string;
  /** Its base version; 0: none. */
  basedOn: number;
  /** [ms since 1970] */
  at: number;
}

export function storedDraft(store: Store | null, account: string, robotType: string, name: string): StoredValue<Draft> {
  return new StoredValue(store, `draft.${account}.${robotType}.${name}`, isDraft);
}

export function storedParameters(
  store: Store | null,
  account: string,
  robotType: string,
  name: string,
): StoredValue<Record<string, unknown>> {
  return new StoredValue(store, `parameters.${account}.${robotType}.${name}`, isRecord);
}

/** What carries setpoints; for all accounts of this browser. */
export function storedTransport(store: Store | null): StoredValue<"mqtt" | "xmpp"> {
  return new StoredValue(store, "setpoints", (value) => value === "mqtt" || value === "xmpp");
}

function isRecord(value: unknown): value is Record<string, unknown> {
  return typeof value === "object" && value !== null && !Array.isArray(value);
}

function isDraft(value: unknown): value is Draft {
  if (!isRecord(value)) return false;
  return typeof value["source"] === "string" && typeof value["basedOn"] === "number" && typeof value["at"] === "number";
}
