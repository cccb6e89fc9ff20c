/** Handing something over for good: the offer, those that are out, and taking them back. For its owner. */
import { Card } from "../../shared/ui/card";
import { Choice } from "../../shared/ui/choice";
import { useEffect, useRef, useState } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import { sentence } from "../../shared/api/http";
import type { Invitation, CreatedInvitation } from "../../shared/api/sharing";
import type { Transferable } from "../../shared/api/transfers";
import { format } from "../../shared/i18n/format";
import { texts } from "./texts";
import { AccountNameField, InlineForm } from "../../shared/ui/inline-form";
import { ConfirmButton } from "../../shared/ui/confirm-button";
import { useReturnFocus } from "../../shared/hooks/use-return-focus";
import { DurationPicker, ONE_DAY, seconds } from "../../shared/ui/duration-picker";
import { LinkOnce } from "../../shared/ui/link-once";
import { usePolling } from "../../shared/hooks/use-polling";
import "./sharing.css";

/** An open offer can be accepted at any time, so it is polled at this interval [ms]. */
const LOOK_AGAIN_MS = 5_000;
const VALID = ["hour", "day", "week", "month"] as const;
const TO = [
  ["name", texts.transfer.toName],
  ["link", texts.transfer.toLink],
] as const;

interface TransferProps {
  api: Api;
  of: Transferable;
  /** All that goes along, by name. */
  goes: readonly string[];
}

export function TransferPanel({ api, of, goes }: TransferProps) {
  const { value: offers, error, refresh } = usePolling(() => api.transfers.open(of), LOOK_AGAIN_MS, [api, of.kind, of.id]);
  const [step, setStep] = useState<"closed" | "asking" | CreatedInvitation>("closed");
  const opener = useReturnFocus(step !== "closed");
  const open = step !== "closed" ? null : (
    <button type="button" ref={opener} data-testid="transfer" onClick={() => setStep("asking")}>
      {texts.transfer.open}
    </button>
  );
  return (
    <div data-testid="transfers">
      <Card title={texts.transfer.title} aside={open}>
        {step === "asking" && (
          <OfferForm
            api={api}
            of={of}
            goes={goes}
            onMade={(made) => {
              setStep(made);
              refresh();
            }}
            onClose={() => setStep("closed")}
          />
        )}
        {typeof step === "object" && (
          <LinkOnce link={step.link} note={texts.transfer.madeNote(format.until(step.expires_at))} onClose={() => setStep("closed")} />
        )}
        {error !== "" && (
          <p class="notice bad" role="alert">
            {texts.transfer.failed(error)}
          </p>
        )}
        {offers?.length === 0 && step === "closed" && <p class="quiet">{texts.transfer.none}</p>}
        {offers !== null && offers.length > 0 && (
          <ul class="people" data-testid="offers">
            {offers.map((offer) => (
              <OpenOffer key={offer.id} offer={offer} withdraw={() => api.transfers.withdraw(of, offer.id)} onGone={refresh} />
            ))}
          </ul>
        )}
      </Card>
    </div>
  );
}

interface OpenOfferProps {
  offer: Invitation;
  withdraw: () => Promise<void>;
  onGone: () => void;
}

function OpenOffer({ offer: { account, expires_at: until }, withdraw, onGone }: OpenOfferProps) {
  const name = texts.transfer.offered(account?.name ?? null);
  return (
    <li>
      <span class="person">
        {name}
        <span class="quiet small">{texts.transfer.waits(format.until(until))}</span>
      </span>
      <ConfirmButton
        label={texts.access.withdraw}
        description={`${texts.access.withdraw}: ${name}`}
        question={texts.transfer.withdrawSure}
        confirmLabel={texts.access.withdrawYes}
        busyLabel={texts.access.withdrawing}
        cancelLabel={texts.access.keep}
        onConfirm={async () => {
          await withdraw();
          onGone();
        }}
      />
    </li>
  );
}

interface OfferFormProps extends TransferProps {
  onMade: (made: CreatedInvitation) => void;
  onClose: () => void;
}

/** What was typed stays until it has come to something. */
function OfferForm({ api, of, goes, onMade, onClose }: OfferFormProps) {
  const [to, setTo] = useState<"name" | "link">("name");
  const [name, setName] = useState("");
  const [valid, setValid] = useState(ONE_DAY);
  const [busy, setBusy] = useState(false);
  const [wrong, setWrong] = useState("");
  const form = useRef<HTMLFormElement>(null);
  useEffect(() => form.current?.querySelector("input")?.focus(), []);
  const send = async (): Promise<void> => {
    setWrong("");
    setBusy(true);
    try {
      onMade(await api.transfers.offer(of, to === "name" ? name.trim() : null, seconds(valid) ?? 0));
    } catch (error) {
      setWrong(sentence(error));
      setBusy(false);
    }
  };
  const { todo, doing, title } = texts.transfer;
  const props = { label: title, submitLabel: todo, busyLabel: doing, busy, error: wrong, form, messageId: "transfer-answer", submitTestId: "transfer-send" };
  return (
    <InlineForm {...props} onSubmit={send} onClose={onClose}>
      <ul class="terms" data-testid="transfer-terms">
        <li>{texts.transfer.goes[of.kind](goes)}</li>
        {texts.transfer.terms.map((line) => (
          <li key={line}>{line}</li>
        ))}
      </ul>
      <Choice label={texts.transfer.to} value={to} options={TO} onChange={setTo} />
      {to === "name" && (
        <AccountNameField id="transfer-name" messageId="transfer-answer" value={name} invalid={wrong !== ""} onInput={setName} />
      )}
      <DurationPicker id="transfer-valid" label={texts.transfer.valid} value={valid} choices={VALID} onChange={setValid} />
    </InlineForm>
  );
}
