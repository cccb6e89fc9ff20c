/** Control bar rows: request control, respond to a request, take over. They extend the bar and cover nothing. */
import type { DeviceStore } from "../devices/model";
import { useComputed } from "@preact/signals";
import { useEffect, useId, useRef, useState } from "preact/hooks";
import type { ControlRequestState } from "./model/control-request";
import { clock } from "../../shared/lib/clock";
import type { Control } from "./model/lease";
import { texts } from "./texts";

/** Remaining seconds, hidden from screen readers, which would announce every second. */
function Left({ until, as }: { until: number; as: (s: number) => string }) {
  const text = useComputed(() => as(Math.max(0, Math.ceil((until - clock.value) / 1000))));
  return (
    <span class="left" aria-hidden="true">
      {text}
    </span>
  );
}

export function RequestControlButton({ control }: { control: Control }) {
  const { kind } = control.asking.state.value;
  if (kind === "open") {
    return (
      <button type="button" data-testid="withdraw-request" onClick={() => void control.asking.withdraw()}>
        {texts.handover.withdraw}
      </button>
    );
  }
  return (
    <button
      type="button"
      class="primary"
      data-testid="ask-control"
      disabled={kind === "sending"}
      onClick={() => void control.asking.ask()}
    >
      {kind === "sending" ? texts.handover.asking : texts.handover.ask}
    </button>
  );
}

/** The outcome of the control request. */
export function PendingRequest({ control }: { control: Control }) {
  const state = control.asking.state.value;
  return (
    <div role="status" class={state.kind === "none" || state.kind === "sending" ? undefined : "bar-row"} data-testid="asked">
      {state.kind === "open" && (
        <>
          <span>
            {texts.handover.asked(state.of || texts.handover.operator)} {!state.shown && texts.handover.notShown}
          </span>
          <Left until={state.until} as={texts.handover.left} />
        </>
      )}
      {(state.kind === "over" || state.kind === "failed") && (
        <Read text={became(state)} control={control} wrong={state.kind === "failed"} />
      )}
    </div>
  );
}

function became(state: Extract<ControlRequestState, { kind: "over" | "failed" }>): string {
  if (state.kind === "failed") return texts.handover.failed(state.why);
  return texts.handover.over[state.how](state.of || texts.handover.operator);
}

function Read({ text, control, wrong = false }: { text: string; control: Control; wrong?: boolean }) {
  return (
    <>
      <span class={wrong ? "bad-text" : undefined}>{text}</span>
      <button type="button" class="plain" onClick={() => control.read()}>
        {texts.control.read}
      </button>
    </>
  );
}

/** The requester, the remaining time and both responses. Does not move the focus, because the operator is steering. */
export function AnswerRequest({ control }: { control: Control }) {
  const asked = control.asked.value;
  const answered = control.answered.value;
  const sending = answered.kind === "sending";
  // The request ended without our response: withdrawn or expired.
  const [gone, setGone] = useState("");
  const last = useRef<string | null>(null);
  const held = control.state.value.kind === "held";
  useEffect(() => {
    if (asked !== null) {
      last.current = asked.by;
      setGone("");
    } else {
      if (last.current !== null && held && answered.kind === "none") setGone(last.current);
      last.current = null;
    }
  }, [asked?.id]);

  const said = answered.kind === "kept" ? texts.handover.kept(answered.from) : "";
  return (
    <>
      <div role="alert" class={asked === null ? undefined : "bar-row asks"} data-testid="asks">
        {asked !== null && <strong>{texts.handover.wants(asked.by)}</strong>}
        {asked !== null && <span class="quiet small">{texts.handover.effect}</span>}
      </div>
      {asked !== null && (
        <div class="bar-row" role="group" aria-label={texts.handover.wants(asked.by)}>
          <button type="button" class="primary" data-testid="accept-request" disabled={sending} onClick={() => void control.answer(true)}>
            {sending && answered.accept ? texts.handover.accepting : texts.handover.accept(asked.by)}
          </button>
          <button type="button" data-testid="refuse-request" disabled={sending} onClick={() => void control.answer(false)}>
            {sending && !answered.accept ? texts.handover.refusing : texts.handover.keep}
          </button>
          <Left until={asked.until} as={texts.handover.leftFor} />
        </div>
      )}
      <div role="status" class={said === "" && answered.kind !== "failed" && gone === "" ? undefined : "bar-row"} data-testid="answered">
        {said !== "" && asked === null && <Read text={said} control={control} />}
        {answered.kind === "failed" && <Read text={texts.handover.failed(answered.why)} control={control} wrong />}
        {gone !== "" && answered.kind === "none" && held && asked === null && <span>{texts.handover.gone(gone)}</span>}
      </div>
    </>
  );
}

interface TakeOverProps {
  device: DeviceStore;
  control: Control;
  onClose: () => void;
}

/** Takeover interrupts the current operator and cannot be undone, so it requires a reason, which that operator sees. */
export function TakeOverForm({ device, control, onClose }: TakeOverProps) {
  const id = useId();
  const [reason, setReason] = useState("");
  const field = useRef<HTMLInputElement>(null);
  useEffect(() => field.current?.focus(), []);
  return (
    <form
      class="bar-row"
      onSubmit={(event) => {
        event.preventDefault();
        void control.takeOver(reason.trim()).then(onClose);
      }}
    >
      <label for={id}>{texts.handover.reason(device.holder.value?.name ?? "")}</label>
      <input
        id={id}
        ref={field}
        type="text"
        required
        pattern=".*\S.*"
        maxLength={200}
        autocomplete="off"
        value={reason}
        aria-describedby={`${id}-note`}
        data-testid="take-over-reason"
        onInput={(event) => setReason(event.currentTarget.value)}
      />
      <button type="submit" class="danger" data-testid="take-over-now">
        {texts.handover.takeOverNow}
      </button>
      <button type="button" onClick={onClose}>
        {texts.handover.never}
      </button>
      <span class="quiet small" id={`${id}-note`}>
        {texts.handover.reasonNote}
      </span>
    </form>
  );
}
