/** Transfers an agent with its devices, or a space with its content, to another account. */
import type { Http } from "./http";
import type { Invitation, InvitationMade } from "./sharing";

/** Kinds of transferable resources. */
export interface Whole {
  kind: "agent" | "space";
  id: string;
}

/** All methods throw only `ApiError`. */
export class Transfers {
  readonly #http: Http;

  constructor(http: Http) {
    this.#http = http;
  }

  /** Open offers, oldest first. */
  open(of: Whole): Promise<Invitation[]> {
    return this.#http.all(at(of));
  }

  /** `account`: the name of the only account that may accept it; `null`: any account with the link. */
  offer(of: Whole, account: string | null, forS: number): Promise<InvitationMade> {
    return this.#http.call("POST", at(of), { body: { account, expires_in_s: forS } });
  }

  async withdraw(of: Whole, id: string): Promise<void> {
    await this.#http.call("DELETE", `${at(of)}/${id}`);
  }
}

function at({ kind, id }: Whole): string {
  return `/${kind}s/${id}/transfers`;
}
