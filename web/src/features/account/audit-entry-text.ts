/** One record of the audit list in plain English. */
import { subjectOf } from "./model/audit-log";
import type { AuditRecord, Role } from "../../shared/api/sharing";
import { common } from "../../shared/i18n/common";
import { format } from "../../shared/i18n/format";
import { texts } from "./texts";

/** Names by record id. An id without a name is shown as it is. */
export interface Names {
  accounts: ReadonlyMap<string, string>;
  /** Devices and spaces. */
  things: ReadonlyMap<string, string>;
  keys: ReadonlyMap<string, string>;
}

const says = texts.audit.says;
const ID_SHOWN = 8;

export function entryText(record: AuditRecord, names: Names): string {
  const { event, data } = record;
  const message = data["message"];
  // Control entries carry their own text.
  if (typeof message === "string") return message;
  const who = whoDid(record);
  const on = thing(record.target, names);
  switch (event) {
    case "signed-in":
      return says.signedIn(who, says.how[text(data, "how")] ?? "");
    case "sign-in-rejected":
      return says.refusedSignIn;
    case "signed-out":
      return record.key === "" ? says.signedOut(who) : says.keyEnded(who);
    case "account-made":
      return says.accountMade(who);
    case "password-set":
      return says.passwordSet(who);
    case "api-key-made":
      return says.keyMade(who, text(data, "name"), role(data), kept(data["only"], names));
    case "api-key-revoked":
      return says.keyRevoked(who, names.keys.get(subjectOf(record.target)[1]) ?? "");
    case "space-made":
      return says.spaceMade(who, text(data, "name"));
    case "agent-claimed":
      return says.claimed(who, on, thing(text(data, "space"), names));
    case "claim-rejected":
      return says.claimRefused(who);
    case "agent-unpaired":
      return says.unpaired(who, on);
    case "agent-moved":
      return says.moved(who, on, thing(text(data, "space"), names));
    case "device-renamed":
      return says.renamed(who, text(data, "label"), on);
    case "shared":
      return says.shared(who, on, other(data, names), role(data), until(data["expires_ms"]));
    case "unshared":
      if (record.actor === "") return says.ranOut(on, other(data, names));
      if (data["with"] === record.account) return says.left(who, on);
      return says.unshared(who, on, other(data, names));
    case "invited":
      return data["role"] === "owner"
        ? says.offered(who, on)
        : says.invited(who, on, role(data), texts.audit.usesLeft(Number(data["uses"] ?? 1)));
    case "invitation-redeemed":
      return says.redeemed(who, on);
    case "invitation-revoked":
      return says.withdrawn(who, on);
    case "transferred":
      return says.transferred(who, on);
    case "movement-saved":
      return says.movementSaved(who, record.target);
    case "movement-deleted":
      return says.movementDeleted(who, record.target);
    case "robot-type-uploaded":
      return says.typeUploaded(who, record.target);
    case "robot-type-deleted":
      return says.typeDeleted(who, record.target);
    default:
      return says.other(who, texts.audit.kinds[event] ?? event, on);
  }
}

function whoDid({ actor, account }: AuditRecord): string {
  if (actor !== "") return actor;
  return account === "" ? texts.audit.cloud : texts.audit.unknownAccount;
}

function thing(on: string, names: Names): string {
  const [, id] = subjectOf(on);
  return names.things.get(id) ?? id;
}

function other(data: AuditRecord["data"], names: Names): string {
  const id = text(data, "with");
  const name = text(data, "name");
  return name === "" ? (names.accounts.get(id) ?? texts.audit.anAccount(id.slice(0, ID_SHOWN))) : name;
}

function kept(only: unknown, names: Names): string {
  if (!Array.isArray(only) || only.length === 0) return texts.keys.everything;
  return texts.keys.onlyThese(only.map((each) => thing(String(each), names)).join(", "));
}

function role(data: AuditRecord["data"]): string {
  const given = text(data, "role");
  return given in common.role ? common.role[given as Role] : given;
}

/** A missing end is stored as a time in the far future; times after this limit mean "no end". */
const NEVER_MS = Date.UTC(9000, 0);

function until(ms: unknown): string {
  return format.until(typeof ms === "number" && ms < NEVER_MS ? new Date(ms).toISOString() : null);
}

function text(data: AuditRecord["data"], name: string): string {
  const value = data[name];
  return typeof value === "string" ? value : "";
}
