/** One record of the audit list in plain English. */
import { subjectOf } from "./model/audit-log";
import type { AuditRecord, Role } from "../../shared/api/sharing";
import { common } from "../../shared/i18n/common";
import { format } from "../../shared/i18n/format";
import { browserName } from "./model/sign-in-notice";
import { texts } from "./texts";

/** Names by record id. Ids without a name are shown unchanged. */
export interface Names {
  accounts: ReadonlyMap<string, string>;
  /** Devices and spaces. */
  targets: ReadonlyMap<string, string>;
  keys: ReadonlyMap<string, string>;
}

const sentences = texts.audit.sentences;
const ID_SHOWN = 8;

export function entryText(record: AuditRecord, names: Names): string {
  const { event, data } = record;
  const message = data["message"];
  // Control entries carry their own text.
  if (typeof message === "string") return message;
  const caller = callerName(record);
  const target = targetName(record.target, names);
  switch (event) {
    case "signed-in":
      return sentences.signedIn(
        caller,
        sentences.method[text(data, "how")] ?? "",
        browserName(text(data, "program")),
        text(data, "address"),
      );
    case "sign-in-rejected":
      return sentences.signInRejected;
    case "signed-out":
      return record.key === "" ? sentences.signedOut(caller) : sentences.allSessionsEnded(caller);
    case "account-made":
      return sentences.accountCreated(caller);
    case "password-set":
      return sentences.passwordSet(caller);
    case "second-factor-enabled":
      return sentences.factorEnabled(caller);
    case "second-factor-disabled":
      return sentences.factorDisabled(caller);
    case "recovery-codes-made":
      return sentences.recoveryCodesMade(caller);
    case "api-key-made":
      return sentences.keyCreated(caller, text(data, "name"), role(data), scopeText(data["only"], names));
    case "api-key-revoked":
      return sentences.keyRevoked(caller, names.keys.get(subjectOf(record.target)[1]) ?? "");
    case "space-made":
      return sentences.spaceCreated(caller, text(data, "name"));
    case "agent-claimed":
      return sentences.claimed(caller, target, targetName(text(data, "space"), names));
    case "claim-rejected":
      return sentences.claimRejected(caller);
    case "agent-unpaired":
      return sentences.unpaired(caller, target);
    case "agent-moved":
      return sentences.moved(caller, target, targetName(text(data, "space"), names));
    case "device-renamed":
      return sentences.renamed(caller, text(data, "label"), target);
    case "camera-consent-set":
      return sentences.cameraConsent(caller, list(data, "cameras"), target);
    case "shared":
      return sentences.shared(caller, target, otherAccount(data, names), role(data), until(data["expires_ms"]));
    case "unshared":
      if (record.actor === "") return sentences.accessExpired(target, otherAccount(data, names));
      if (data["with"] === record.account) return sentences.accessGivenUp(caller, target);
      return sentences.unshared(caller, target, otherAccount(data, names));
    case "invited":
      return data["role"] === "owner"
        ? sentences.offered(caller, target)
        : sentences.invited(caller, target, role(data), texts.audit.usesLeft(Number(data["uses"] ?? 1)));
    case "invitation-redeemed":
      return sentences.redeemed(caller, target);
    case "invitation-revoked":
      return sentences.withdrawn(caller, target);
    case "transferred":
      return sentences.transferred(caller, target);
    case "movement-saved":
      return sentences.movementSaved(caller, record.target);
    case "movement-deleted":
      return sentences.movementDeleted(caller, record.target);
    case "robot-type-uploaded":
      return sentences.typeUploaded(caller, record.target);
    case "robot-type-deleted":
      return sentences.typeDeleted(caller, record.target);
    default:
      return sentences.other(caller, texts.audit.kinds[event] ?? event, target);
  }
}

function callerName({ actor, account }: AuditRecord): string {
  if (actor !== "") return actor;
  return account === "" ? texts.audit.server : texts.audit.unknownAccount;
}

function targetName(target: string, names: Names): string {
  const [, id] = subjectOf(target);
  return names.targets.get(id) ?? id;
}

function otherAccount(data: AuditRecord["data"], names: Names): string {
  const id = text(data, "with");
  const name = text(data, "name");
  return name === "" ? (names.accounts.get(id) ?? texts.audit.deletedAccount(id.slice(0, ID_SHOWN))) : name;
}

function scopeText(only: unknown, names: Names): string {
  if (!Array.isArray(only) || only.length === 0) return texts.keys.everything;
  return texts.keys.onlyScope(only.map((each) => targetName(String(each), names)).join(", "));
}

function role(data: AuditRecord["data"]): string {
  const value = text(data, "role");
  return value in common.role ? common.role[value as Role] : value;
}

/** A missing end is stored as a time in the far future; times after this limit mean "no end". */
const NEVER_MS = Date.UTC(9000, 0);

function until(ms: unknown): string {
  return format.until(typeof ms === "number" && ms < NEVER_MS ? new Date(ms).toISOString() : null);
}

function list(data: AuditRecord["data"], name: string): string {
  const value = data[name];
  return Array.isArray(value) ? value.map(String).join(", ") : "";
}

function text(data: AuditRecord["data"], name: string): string {
  const value = data[name];
  return typeof value === "string" ? value : "";
}
