/** Tokens that mark this browser as known to accounts: other browsers cannot slow or lock its sign-in. */
import { StoredValue } from "../../../shared/lib/local-storage";

type Store = ConstructorParameters<typeof StoredValue>[0];
type Tokens = Record<string, string>;

const MAX_NAMES = 8;
/** The key of the last sign-in, for sign-in links, which contain no name. */
const LAST = "";

export class KnownBrowser {
  readonly #stored: StoredValue<Tokens>;

  constructor(store: Store) {
    this.#stored = new StoredValue(store, "known-browser", isTokens);
  }

  /** The token for a name; without a name, of the last sign-in. Empty if there is none. */
  token(name = LAST): string {
    return this.#stored.read()?.[key(name)] ?? "";
  }

  remember(token: string, name = LAST): void {
    const others = Object.entries(this.#stored.read() ?? {}).filter(([other]) => other !== LAST && other !== key(name));
    const names = name === LAST ? others : [...others, [key(name), token] as const];
    this.#stored.write(Object.fromEntries([[LAST, token], ...names.slice(-MAX_NAMES)]));
  }
}

function key(name: string): string {
  return name.trim().toLowerCase();
}

function isTokens(value: unknown): value is Tokens {
  return typeof value === "object" && value !== null && Object.values(value).every((token) => typeof token === "string");
}
