/** The signed-in account. The token of a sign-in link is used once and never stored. */
import type { Account } from "../../../shared/api/types";
import { signal, type ReadonlySignal } from "@preact/signals-core";
import type { Api } from "../../../shared/api/client";
import { ApiError, sentence } from "../../../shared/api/http";

type SessionState =
  | { kind: "checking" }
  /** `why`: the error of a sign-in link or the reason for the session's end; empty on a first visit. */
  | { kind: "out"; reason: string }
  | { kind: "in"; account: Account };

export class Session {
  readonly #api: Api;
  readonly #state = signal<SessionState>({ kind: "checking" });
  readonly state: ReadonlySignal<SessionState> = this.#state;

  constructor(api: Api) {
    this.#api = api;
  }

  /**
   * Signs in with a link's token, or resumes the browser's session.
   *
   * `failed`: the error of an external sign-in from which the browser has just returned.
   */
  async start(link: string | null, failed = ""): Promise<void> {
    this.#state.value = { kind: "checking" };
    try {
      if (link !== null) await this.#api.signIn(link);
      // From here on the cookie identifies the session: this call proves that the browser stored it.
      this.#state.value = { kind: "in", account: await this.#api.me() };
    } catch (error) {
      const firstVisit = link === null && error instanceof ApiError && error.status === 401;
      this.#state.value = { kind: "out", reason: firstVisit ? failed : sentence(error) };
    }
  }

  /** Signs in with name and password. Throws the server's error. */
  async signInWithPassword(name: string, password: string): Promise<void> {
    await this.#api.signInByPassword(name, password);
    this.#state.value = { kind: "in", account: await this.#api.me() };
  }

  /** Creates an account with an invitation and signs in to it. Throws the server's error. */
  async createAccount(invitation: string, name: string, password: string): Promise<void> {
    await this.#api.createAccount(invitation, name, password);
    this.#state.value = { kind: "in", account: await this.#api.me() };
  }

  async signOut(): Promise<void> {
    try {
      await this.#api.signOut();
    } finally {
      this.#state.value = { kind: "out", reason: "" };
    }
  }

  /** The session has expired on the server. */
  expire(reason: string): void {
    if (this.#state.value.kind === "in") this.#state.value = { kind: "out", reason };
  }
}

/** The token in a URL fragment, `#sign-in=<token>`, or `null`. */
export function signInToken(hash: string): string | null {
  const match = /^#sign-in=([^&]+)$/.exec(hash);
  if (match?.[1] === undefined) return null;
  try {
    return decodeURIComponent(match[1]);
  } catch {
    return null;
  }
}

/** The error code of an external sign-in, in `#sign-in-failed=<code>`, or `null`. */
export function signInFailure(hash: string): string | null {
  return /^#sign-in-failed=([a-z-]{1,40})$/.exec(hash)?.[1] ?? null;
}
