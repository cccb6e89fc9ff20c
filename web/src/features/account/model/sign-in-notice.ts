/** Sign-ins of unknown browsers that the user of this browser has not confirmed. */
import type { PastSignIn } from "../../../shared/api/account";
import { StoredValue } from "../../../shared/lib/local-storage";

type Store = ConstructorParameters<typeof StoredValue>[0];

/** Remembers in this browser, because another session must not be able to hide a sign-in. */
export class ConfirmedSignIns {
  /** The time of the newest confirmed sign-in (RFC 3339). */
  readonly #until: StoredValue<string>;

  constructor(store: Store, account: string) {
    this.#until = new StoredValue(store, `confirmed-sign-ins.${account}`, (value) => typeof value === "string");
  }

  /** Unconfirmed sign-ins of other, unknown browsers, newest first. A new browser begins with its own sign-in. */
  unconfirmed(signIns: readonly PastSignIn[]): PastSignIn[] {
    let until = this.#until.read();
    if (until === null) {
      until = (signIns.find(({ mine }) => mine) ?? signIns[0])?.at ?? "";
      this.#until.write(until);
    }
    const confirmed = until;
    return signIns.filter(({ at, mine, known_browser: known }) => !mine && !known && at > confirmed);
  }

  confirm(signIns: readonly PastSignIn[]): void {
    const newest = signIns[0];
    if (newest !== undefined) this.#until.write(newest.at);
  }
}

const BROWSERS = [
  ["Edg/", "Edge"],
  ["OPR/", "Opera"],
  ["Firefox/", "Firefox"],
  ["Chrome/", "Chrome"],
  ["Safari/", "Safari"],
] as const;
const SYSTEMS = [
  ["Android", "Android"],
  ["iPhone", "iPhone"],
  ["iPad", "iPad"],
  ["Windows", "Windows"],
  ["Mac OS", "macOS"],
  ["Linux", "Linux"],
] as const;

/** Browser and system of a user agent, which its sender can choose freely; for other programs the first word. */
export function browserName(userAgent: string): string {
  const browser = BROWSERS.find(([mark]) => userAgent.includes(mark))?.[1];
  const system = SYSTEMS.find(([mark]) => userAgent.includes(mark))?.[1];
  if (browser === undefined) return userAgent.split(" ")[0]?.slice(0, 40) ?? "";
  return system === undefined ? browser : `${browser}, ${system}`;
}
