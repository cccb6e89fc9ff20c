/** Names of accounts with a short id: names can resemble each other, and an account cannot choose its id. */
const ID_SHOWN = 6;

/** The first characters of an account id. */
export function shortId(account: string): string {
  return `#${account.slice(0, ID_SHOWN)}`;
}

/** A name with the short id; without an id, only the name. */
export function accountLabel(name: string, account: string | undefined): string {
  return account === undefined || account === "" ? name : `${name} ${shortId(account)}`;
}
