/** Second factor, sessions and recent sign-ins of the account. */
import type { Http } from "./http";
import type { SignInSession } from "./types";

export interface SecondFactor {
  enabled: boolean;
  enabled_at: string | null;
  /** Number of unused recovery codes. */
  recovery_codes: number;
}

export interface SecondFactorSecret {
  secret: string;
  otpauth_uri: string;
  /** Rows of the QR code; `1`: black. */
  qr: string[];
}

export interface PastSignIn {
  session: string;
  method: SignInSession["method"];
  at: string;
  address: string;
  program: string;
  known_browser: boolean;
  mine: boolean;
}

const FACTOR = "/accounts/me/second-factor";

/** All methods throw only `ApiError`. */
export class AccountApi {
  readonly #http: Http;

  constructor(http: Http) {
    this.#http = http;
  }

  async setPassword(password: string, old: string): Promise<void> {
    const body = old === "" ? { password } : { password, old_password: old };
    await this.#http.call("PUT", "/accounts/me/password", { body });
  }

  sessions(): Promise<SignInSession[]> {
    return this.#http.all("/accounts/me/sessions");
  }

  async endSession(id: string): Promise<void> {
    await this.#http.call("DELETE", `/accounts/me/sessions/${id}`);
  }

  async endOtherSessions(): Promise<void> {
    await this.#http.call("DELETE", "/accounts/me/sessions");
  }

  signIns(): Promise<PastSignIn[]> {
    return this.#http.all("/accounts/me/sign-ins");
  }

  secondFactor(): Promise<SecondFactor> {
    return this.#http.call("GET", FACTOR);
  }

  /** A new secret, which has no effect until it is enabled. `password` may be empty after a sign-in by link. */
  addSecondFactor(password: string): Promise<SecondFactorSecret> {
    return this.#http.call("POST", FACTOR, { body: password === "" ? {} : { password } });
  }

  /** Returns the recovery codes. */
  enableSecondFactor(code: string): Promise<string[]> {
    return this.#recoveryCodes("enable", code);
  }

  renewRecoveryCodes(code: string): Promise<string[]> {
    return this.#recoveryCodes("recovery-codes", code);
  }

  async disableSecondFactor(code: string): Promise<void> {
    await this.#http.call("POST", `${FACTOR}/disable`, { body: { code } });
  }

  async #recoveryCodes(change: string, code: string): Promise<string[]> {
    const response = await this.#http.call<{ recovery_codes: string[] }>("POST", `${FACTOR}/${change}`, { body: { code } });
    return response.recovery_codes;
  }
}
