/** An opened invitation link. Its secret stays in this tab until the user responds, also during an external sign-in. */
import { signal, type ReadonlySignal } from "@preact/signals-core";

const KEY = "telescope.invitation";
const AWAY = "telescope.invitation.away";

type Followed =
  | { kind: "none" }
  /** `away`: an external sign-in was started. If it created an account, it has already redeemed the invitation. */
  | { kind: "open"; secret: string; away: boolean }
  /** Redeemed by creating an account with it, so it can no longer be previewed. */
  | { kind: "joined" };

/** The required methods of the tab's storage. */
export type TabStorage = Pick<Storage, "getItem" | "setItem" | "removeItem">;

export class FollowedInvitation {
  readonly #storage: TabStorage;
  readonly #state;
  readonly state: ReadonlySignal<Followed>;

  constructor(storage: TabStorage) {
    this.#storage = storage;
    const secret = storage.getItem(KEY);
    this.#state = signal<Followed>(
      secret === null ? { kind: "none" } : { kind: "open", secret, away: storage.getItem(AWAY) !== null },
    );
    this.state = this.#state;
  }

  follow(secret: string): void {
    this.#storage.setItem(KEY, secret);
    this.#storage.removeItem(AWAY);
    this.#state.value = { kind: "open", secret, away: false };
  }

  /** Records that the browser leaves for an external sign-in with the invitation. */
  markAway(): void {
    this.#storage.setItem(AWAY, "1");
  }

  /** The invitation was redeemed, declined or is invalid. */
  drop(): void {
    this.#clearStorage();
    this.#state.value = { kind: "none" };
  }

  joined(): void {
    this.#clearStorage();
    this.#state.value = { kind: "joined" };
  }

  #clearStorage(): void {
    this.#storage.removeItem(KEY);
    this.#storage.removeItem(AWAY);
  }
}

/** The secret in a URL fragment, `#invitation=<secret>`, or `null`. */
export function invitationSecret(hash: string): string | null {
  return /^#invitation=([A-Za-z0-9._~-]{1,200})$/.exec(hash)?.[1] ?? null;
}
