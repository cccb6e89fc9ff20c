import { Choice } from "../../shared/ui/choice";
import { useEffect, useRef, useState } from "preact/hooks";
import { sentence } from "../../shared/api/http";
import type { CreatedInvitation, SharedRole } from "../../shared/api/sharing";
import type { ShareList } from "./model/shares";
import { common } from "../../shared/i18n/common";
import { format } from "../../shared/i18n/format";
import { texts } from "./texts";
import { AccountNameField, InlineForm } from "../../shared/ui/inline-form";
import { NO_EXPIRY, DurationPicker, ONE_DAY, seconds } from "../../shared/ui/duration-picker";
import { LinkOnce } from "../../shared/ui/link-once";

const HOW = [
  ["link", texts.invite.byLink],
  ["name", texts.invite.byName],
] as const;
export const MAY = [
  ["operator", texts.invite.operate],
  ["viewer", texts.invite.watch],
] as const;
const LASTS = ["never", "hour", "workday", "day", "week", "month", "date"] as const;
const VALID = ["hour", "day", "week", "month"] as const;

interface InviteFormProps {
  sharing: ShareList;
  onClose: () => void;
}

/** Invites an account by name or by a link. Input stays until the invitation succeeds. */
export function InviteForm({ sharing, onClose }: InviteFormProps) {
  const [how, setHow] = useState<"link" | "name">("link");
  const [name, setName] = useState("");
  const [role, setRole] = useState<SharedRole>("operator");
  const [lasts, setLasts] = useState(NO_EXPIRY);
  const [uses, setUses] = useState("1");
  const [valid, setValid] = useState(ONE_DAY);
  const [busy, setBusy] = useState(false);
  const [wrong, setWrong] = useState("");
  const [done, setDone] = useState("");
  const [made, setMade] = useState<CreatedInvitation | null>(null);
  const form = useRef<HTMLFormElement>(null);
  useEffect(() => form.current?.querySelector("input")?.focus(), []);

  const send = async (): Promise<void> => {
    setWrong("");
    setDone("");
    const forS = seconds(lasts);
    if (forS === undefined) {
      setWrong(common.duration.past);
      return;
    }
    setBusy(true);
    try {
      if (how === "name") {
        const share = await sharing.put(name.trim(), role, forS);
        setDone(texts.invite.shared(share.account.name));
        setName("");
      } else {
        const validS = seconds(valid) ?? 0; // Its choices are all lengths.
        setMade(await sharing.invite({ role, uses: Number(uses), share_s: forS, expires_in_s: validS }));
      }
    } catch (error) {
      setWrong(sentence(error));
    } finally {
      setBusy(false);
    }
  };

  if (made !== null) {
    const note = texts.invite.madeNote(common.role[made.role], made.uses, format.until(made.expires_at));
    return <LinkOnce link={made.link} note={note} onClose={onClose} />;
  }
  return (
    <InlineForm
      label={texts.invite.title}
      submitLabel={how === "name" ? texts.invite.share : texts.invite.make}
      busyLabel={how === "name" ? texts.invite.sharing : texts.invite.making}
      busy={busy}
      cancelLabel={texts.invite.close}
      error={wrong}
      successMessage={done}
      messageId="invite-answer"
      form={form}
      submitTestId="invite-send"
      onSubmit={send}
      onClose={onClose}
    >
      <Choice label={texts.invite.how} value={how} options={HOW} onChange={setHow} />
      <p class="quiet small">{how === "name" ? texts.invite.nameNote : texts.invite.linkNote}</p>
      {how === "name" && (
        <AccountNameField id="invite-name" messageId="invite-answer" value={name} invalid={wrong !== ""} onInput={setName} />
      )}
      <div class="field">
        <span class="label">{texts.invite.role}</span>
        <Choice label={texts.invite.role} value={role} options={MAY} onChange={setRole} />
        <p class="quiet small">{texts.roleExplained[role]}</p>
      </div>
      <DurationPicker id="invite-lasts" label={texts.invite.lasts} value={lasts} choices={LASTS} onChange={setLasts} />
      {how === "link" && (
        <>
          <DurationPicker id="invite-valid" label={texts.invite.valid} value={valid} choices={VALID} onChange={setValid} />
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
