import { Choice } from "../../shared/ui/choice";
import { useEffect, useRef, useState } from "preact/hooks";
import { sentence } from "../../shared/api/http";
import type { CreatedInvitation, SharedRole } from "../../shared/api/sharing";
import type { ShareList } from "./model/shares";
import { common } from "../../shared/i18n/common";
import { format } from "../../shared/i18n/format";
import { accountLabel } from "../../shared/lib/account-label";
import { texts } from "./texts";
import { AccountNameField, InlineForm } from "../../shared/ui/inline-form";
import { NO_EXPIRY, DurationPicker, ONE_DAY, seconds } from "../../shared/ui/duration-picker";
import { LinkOnce } from "../../shared/ui/link-once";

const METHODS = [
  ["link", texts.invite.byLink],
  ["name", texts.invite.byName],
] as const;
export const SHARED_ROLES = [
  ["operator", texts.invite.operate],
  ["viewer", texts.invite.watch],
] as const;
const DURATIONS = ["never", "hour", "workday", "day", "week", "month", "date"] as const;
const VALIDITIES = ["hour", "day", "week", "month"] as const;

interface InviteFormProps {
  sharing: ShareList;
  onClose: () => void;
}

/** Invites an account by name or by a link. Input stays until the invitation succeeds. */
export function InviteForm({ sharing, onClose }: InviteFormProps) {
  const [method, setMethod] = useState<"link" | "name">("link");
  const [name, setName] = useState("");
  const [role, setRole] = useState<SharedRole>("operator");
  const [duration, setDuration] = useState(NO_EXPIRY);
  const [uses, setUses] = useState("1");
  const [valid, setValid] = useState(ONE_DAY);
  const [busy, setBusy] = useState(false);
  const [error, setError] = useState("");
  const [message, setMessage] = useState("");
  const [invitation, setInvitation] = useState<CreatedInvitation | null>(null);
  const form = useRef<HTMLFormElement>(null);
  useEffect(() => form.current?.querySelector("input")?.focus(), []);

  const send = async (): Promise<void> => {
    setError("");
    setMessage("");
    const forS = seconds(duration);
    if (forS === undefined) {
      setError(common.duration.past);
      return;
    }
    setBusy(true);
    try {
      if (method === "name") {
        const share = await sharing.share(name.trim(), role, forS);
        setMessage(texts.invite.shared(accountLabel(share.account.name, share.account.id)));
        setName("");
      } else {
        const validS = seconds(valid) ?? 0; // All its choices are durations.
        setInvitation(await sharing.invite({ role, uses: Number(uses), share_s: forS, expires_in_s: validS }));
      }
    } catch (error) {
      setError(sentence(error));
    } finally {
      setBusy(false);
    }
  };

  if (invitation !== null) {
    const note = texts.invite.madeNote(common.role[invitation.role], invitation.uses, format.until(invitation.expires_at));
    return <LinkOnce link={invitation.link} note={note} onClose={onClose} />;
  }
  return (
    <InlineForm
      label={texts.invite.title}
      submitLabel={method === "name" ? texts.invite.share : texts.invite.make}
      busyLabel={method === "name" ? texts.invite.sharing : texts.invite.making}
      busy={busy}
      cancelLabel={texts.invite.close}
      error={error}
      successMessage={message}
      messageId="invite-answer"
      form={form}
      submitTestId="invite-send"
      onSubmit={send}
      onClose={onClose}
    >
      <Choice label={texts.invite.method} value={method} options={METHODS} onChange={setMethod} />
      <p class="quiet small">{method === "name" ? texts.invite.nameNote : texts.invite.linkNote}</p>
      {method === "name" && (
        <AccountNameField id="invite-name" messageId="invite-answer" value={name} invalid={error !== ""} onInput={setName} />
      )}
      <div class="field">
        <span class="label">{texts.invite.role}</span>
        <Choice label={texts.invite.role} value={role} options={SHARED_ROLES} onChange={setRole} />
        <p class="quiet small">{texts.roleExplained[role]}</p>
      </div>
      <DurationPicker id="invite-lasts" label={texts.invite.duration} value={duration} choices={DURATIONS} onChange={setDuration} />
      {method === "link" && (
        <>
          <DurationPicker id="invite-valid" label={texts.invite.valid} value={valid} choices={VALIDITIES} onChange={setValid} />
          <div class="field">
            <label for="invite-uses">{texts.invite.uses}</label>
            <input
              id="invite-uses"
              type="number"
              min={1}
              max={50}
              required
              value={uses}
              aria-describedby="invite-uses-note"
              onInput={(event) => setUses(event.currentTarget.value)}
            />
            <p class="quiet small" id="invite-uses-note">
              {texts.invite.usesNote}
            </p>
          </div>
        </>
      )}
    </InlineForm>
  );
}
