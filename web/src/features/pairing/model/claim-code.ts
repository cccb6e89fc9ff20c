/** Parses claim codes, and stores the code of an opened pairing link in this tab until it is used or dropped. */
import type { TabStorage } from "../../sharing/model";
import { signal, type ReadonlySignal } from "@preact/signals-core";

const KEY = "telescope.pair";
/** The alphabet has no vowels, and no letters that resemble digits. */
const CODE = /^[BCDFGHJKLMNPQRSTVWXZ]{8}$/;

/** Normalizes a code to `BCDF-GHJK`; `null`: invalid. Accepts lower case, spaces and hyphens. */
export function readCode(typed: string): string | null {
  const code = typed.toUpperCase().replace(/[^A-Z0-9]/g, "");
  return CODE.test(code) ? `${code.slice(0, 4)}-${code.slice(4)}` : null;
}

/** The code in a URL fragment, `#pair=<code>`; `null` without a valid code. */
export function pairingCode(hash: string): string | null {
  const match = /^#pair=([A-Za-z-]{8,12})$/.exec(hash)?.[1];
  return match === undefined ? null : readCode(match);
}

/** The code of an opened pairing link. The tab's storage retains it during an external sign-in. */
export class FollowedCode {
  readonly #storage: TabStorage;
  readonly #code;
  readonly code: ReadonlySignal<string | null>;

  constructor(storage: TabStorage) {
    this.#storage = storage;
    this.#code = signal(storage.getItem(KEY));
    this.code = this.#code;
  }

  follow(code: string): void {
    this.#storage.setItem(KEY, code);
    this.#code.value = code;
  }

  drop(): void {
    this.#storage.removeItem(KEY);
    this.#code.value = null;
  }
}
