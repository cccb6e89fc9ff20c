/** An opened invitation link. Its secret stays in this tab until the user responds, also during an external sign-in. */
import { signal, type ReadonlySignal } from "@preact/signals-core";

const KEY = "telescope.invitation";
const AWAY = "telescope.invitation.away";

type Followed =
  | { kind: "none" }
  /** `away`: signing in has led to a provider, where an account that was made on the way has taken it already. */
  | { kind: "open"; secret: string; away: boolean }
  /** It was taken by making an account with it, so it may not be there to be looked at any more. */
  | { kind: "joined" };

/** What is needed of the tab's own storage. */
export type Shelf = Pick<Storage, "getItem" | "setItem" | "removeItem">;

export class FollowedInvitation {
  readonly #shelf: Shelf;
  readonly #state;
  readonly state: ReadonlySignal<Followed>;

  constructor(shelf: Shelf) {
    this.#shelf = shelf;
    const secret = shelf.getItem(KEY);
    this.#state = signal<Followed>(
      secret === null ? { kind: "none" } : { kind: "open", secret, away: shelf.getItem(AWAY) !== null },
    );
    this.state = this.#state;
  }

  follow(secret: string): void {
    this.#shelf.setItem(KEY, secret);
    this.#shelf.removeItem(AWAY);
    this.#state.value = { kind: "open", secret, away: false };
  }

  /** The browser leaves for a provider with it. */
  leave(): void {
    this.#shelf.setItem(AWAY, "1");
  }

  /** It was redeemed, or is not wanted, or is worth nothing. */
  drop(): void {
    this.#forget();
    this.#state.value = { kind: "none" };
  }

  joined(): void {
    this.#forget();
    this.#state.value = { kind: "joined" };
  }

  #forget(): void {
    this.#shelf.removeItem(KEY);
    this.#shelf.removeItem(AWAY);
  }
}

/** The secret in an address's fragment, `#invitation=<secret>`, or `null`. */
export function invitationSecret(hash: string): string | null {
  return /^#invitation=([A-Za-z0-9._~-]{1,200})$/.exec(hash)?.[1] ?? null;
}
