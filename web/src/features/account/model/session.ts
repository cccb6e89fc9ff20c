/** The signed-in account. The token of a sign-in link is used once and never stored. */
import type { Account } from "../../../shared/api/types";
import { signal, type ReadonlySignal } from "@preact/signals-core";
import type { Api, SignInExtras } from "../../../shared/api/client";
import { ApiError, sentence } from "../../../shared/api/http";
import type { KnownBrowser } from "./known-browser";

type SessionState =
  | { kind: "checking" }
  /** `why`: the error of a sign-in link or the reason for the session's end; empty on a first visit. */
  | { kind: "out"; reason: string }
  /** The account requires the code of its second factor. */
  | { kind: "code" }
  | { kind: "in"; account: Account };

export class Session {
  readonly #api: Api;
  readonly #browser: KnownBrowser;
  /** Repeats the sign-in that requires a code. */
  #repeat: ((code: string) => Promise<void>) | null = null;
  readonly #state = signal<SessionState>({ kind: "checking" });
  readonly state: ReadonlySignal<SessionState> = this.#state;

  constructor(api: Api, browser: KnownBrowser) {
    this.#api = api;
    this.#browser = browser;
  }

  /**
   * Signs in with a link's token, or resumes the browser's session.
   *
   * `failed`: the error of an external sign-in from which the browser has just returned.
   */
  async start(link: string | null, failed = ""): Promise<void> {
    this.#state.value = { kind: "checking" };
    try {
      if (link !== null && !(await this.#signIn((extras) => this.#api.signIn(link, extras)))) return;
      // From here on the cookie identifies the session: this call proves that the browser stored it.
      this.#state.value = { kind: "in", account: await this.#api.me() };
    } catch (error) {
      const firstVisit = link === null && error instanceof ApiError && error.status === 401;
      this.#state.value = { kind: "out", reason: firstVisit ? failed : sentence(error) };
    }
  }

  /** Signs in with name and password; afterwards a code may be required. Throws the server's error. */
  async signInWithPassword(name: string, password: string): Promise<void> {
    if (!(await this.#signIn((extras) => this.#api.signInByPassword(name, password, extras), name))) return;
    this.#state.value = { kind: "in", account: await this.#api.me() };
  }

  /** Completes a sign-in with the code of the second factor. Throws the server's error. */
  async submitCode(code: string): Promise<void> {
    await this.#repeat?.(code);
    this.#repeat = null;
    this.#state.value = { kind: "in", account: await this.#api.me() };
  }

  cancelCode(): void {
    this.#repeat = null;
    this.#state.value = { kind: "out", reason: "" };
  }

  /** Creates an account with an invitation and signs in to it. Throws the server's error. */
  async createAccount(invitation: string, name: string, password: string): Promise<void> {
    this.#browser.remember(await this.#api.createAccount(invitation, name, password), name);
    this.#state.value = { kind: "in", account: await this.#api.me() };
  }

  /** Whether the sign-in is complete; otherwise it requires a code. */
  async #signIn(call: (extras: SignInExtras) => Promise<string>, name?: string): Promise<boolean> {
    const attempt = async (code: string): Promise<void> => {
      this.#browser.remember(await call({ code, deviceToken: this.#browser.token(name) }), name);
    };
    try {
      await attempt("");
      return true;
    } catch (error) {
      if (!(error instanceof ApiError) || error.code !== "second-factor-required") throw error;
      this.#repeat = attempt;
      this.#state.value = { kind: "code" };
      return false;
    }
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
