/** Who is signed in. The token of a sign-in link is used once and kept nowhere. */
import type { Account } from "../../../shared/api/types";
import { signal, type ReadonlySignal } from "@preact/signals-core";
import type { Api } from "../../../shared/api/client";
import { ApiError, sentence } from "../../../shared/api/http";

export type SessionState =
  | { kind: "checking" }
  /** `why` says what went wrong with a link, or why the session ended; empty at a first visit. */
  | { kind: "out"; why: string }
  | { kind: "in"; account: Account };

export class Session {
  readonly #api: Api;
  readonly #state = signal<SessionState>({ kind: "checking" });
  readonly state: ReadonlySignal<SessionState> = this.#state;

  constructor(api: Api) {
    this.#api = api;
  }

  /**
   * Use a link's token, or find the session that the browser already has.
   *
   * `failed` says what went wrong with signing in elsewhere, where the browser has just come back from.
   */
  async start(link: string | null, failed = ""): Promise<void> {
    this.#state.value = { kind: "checking" };
    try {
      if (link !== null) await this.#api.signIn(link);
      // The cookie is what counts from here on: asking proves that the browser has it.
      this.#state.value = { kind: "in", account: await this.#api.me() };
    } catch (error) {
      const firstVisit = link === null && error instanceof ApiError && error.status === 401;
      this.#state.value = { kind: "out", why: firstVisit ? failed : sentence(error) };
    }
  }

  /** Sign in by name and password. Throws what the server says against it. */
  async enter(name: string, password: string): Promise<void> {
    await this.#api.signInByPassword(name, password);
    this.#state.value = { kind: "in", account: await this.#api.me() };
  }

  /** Make an account with an invitation, and be signed in to it. Throws what the server says against it. */
  async join(invitation: string, name: string, password: string): Promise<void> {
    await this.#api.makeAccount(invitation, name, password);
    this.#state.value = { kind: "in", account: await this.#api.me() };
  }

  async signOut(): Promise<void> {
    try {
      await this.#api.signOut();
    } finally {
      this.#state.value = { kind: "out", why: "" };
    }
  }

  /** The server no longer knows this session. */
  ended(why: string): void {
    if (this.#state.value.kind === "in") this.#state.value = { kind: "out", why };
  }
}

/** The token in an address's fragment, `#sign-in=<token>`, or `null`. */
export function signInToken(hash: string): string | null {
  const found = /^#sign-in=([^&]+)$/.exec(hash);
  if (found?.[1] === undefined) return null;
  try {
    return decodeURIComponent(found[1]);
  } catch {
    return null;
  }
}

/** Why signing in elsewhere came to nothing, in `#sign-in-failed=<code>`, or `null`. */
export function signInFailure(hash: string): string | null {
  return /^#sign-in-failed=([a-z-]{1,40})$/.exec(hash)?.[1] ?? null;
}
