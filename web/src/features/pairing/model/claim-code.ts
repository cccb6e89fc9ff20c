/** A claim code: how it is written, and one whose link was followed. It stays in this tab until it is used or dropped. */
import type { Shelf } from "../../sharing/model";
import { signal, type ReadonlySignal } from "@preact/signals-core";

const KEY = "telescope.pair";
/** The agent's alphabet has no vowels and nothing that looks like a digit. */
const CODE = /^[BCDFGHJKLMNPQRSTVWXZ]{8}$/;

/** Normalizes a code to `BCDF-GHJK`; `null`: invalid. Accepts lower case, spaces and hyphens. */
export function readCode(typed: string): string | null {
  const code = typed.toUpperCase().replace(/[^A-Z0-9]/g, "");
  return CODE.test(code) ? `${code.slice(0, 4)}-${code.slice(4)}` : null;
}

/** The code in an address's fragment, `#pair=<code>`, or `null`: an invalid code is not shown. */
export function pairingCode(hash: string): string | null {
  const found = /^#pair=([A-Za-z-]{8,12})$/.exec(hash)?.[1];
  return found === undefined ? null : readCode(found);
}

/** Signing in may lead away and back: the tab's own storage keeps the code meanwhile. */
export class FollowedCode {
  readonly #shelf: Shelf;
  readonly #code;
  readonly code: ReadonlySignal<string | null>;

  constructor(shelf: Shelf) {
    this.#shelf = shelf;
    this.#code = signal(shelf.getItem(KEY));
    this.code = this.#code;
  }

  follow(code: string): void {
    this.#shelf.setItem(KEY, code);
    this.#code.value = code;
  }

  drop(): void {
    this.#shelf.removeItem(KEY);
    this.#code.value = null;
  }
}
