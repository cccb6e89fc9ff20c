/** Transfers an agent with its devices, or a space with its content, to another account. */
import type { Http } from "./http";
import type { Invitation, CreatedInvitation } from "./sharing";

/** Kinds of transferable resources. */
export interface Transferable {
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
  open(of: Transferable): Promise<Invitation[]> {
    return this.#http.all(at(of));
  }

  /** `account`: the name of the only account that may accept it; `null`: any account with the link. */
  offer(of: Transferable, account: string | null, durationS: number): Promise<CreatedInvitation> {
    return this.#http.call("POST", at(of), { body: { account, expires_in_s: durationS } });
  }

  async withdraw(of: Transferable, id: string): Promise<void> {
    await this.#http.call("DELETE", `${at(of)}/${id}`);
  }
}

function at({ kind, id }: Transferable): string {
  return `/${kind}s/${id}/transfers`;
}
