/** An inline form: fields, submit and cancel buttons, and a result message. */
import type { ComponentChildren, Ref } from "preact";
import { common } from "../i18n/common";

interface AskedFormProps {
  label: string;
  /** Labels of the submit button: idle and busy. */
  todo: string;
  doing: string;
  busy: boolean;
  close?: string;
  /** Empty without a message. */
  wrong: string;
  done?: string;
  /** Id of the message, for `aria-describedby` of invalid fields. */
  answerId?: string;
  form?: Ref<HTMLFormElement>;
  sendTestId?: string;
  onSend: () => Promise<void>;
  onClose: () => void;
  children: ComponentChildren;
}

export function InlineForm({ label, todo, doing, busy, wrong, done = "", onSend, onClose, children, ...rest }: AskedFormProps) {
  return (
    <form
      class="panel fields"
      ref={rest.form}
      aria-label={label}
      onSubmit={(event) => {
        event.preventDefault();
        void onSend();
      }}
    >
      {children}
      <div class="row">
        <button type="submit" class="primary" data-testid={rest.sendTestId} disabled={busy}>
          {busy ? doing : todo}
        </button>
        <button type="button" disabled={busy} onClick={onClose}>
          {rest.close ?? common.form.cancel}
        </button>
      </div>
      <p id={rest.answerId} class={wrong === "" ? "field-note" : "field-error"} aria-live="polite">
        {wrong === "" ? done : wrong}
      </p>
    </form>
  );
}

/** The recipient's account name. The error `wrong` is shown in the form message `answerId`. */
export function AccountNameField(props: { id: string; answerId: string; value: string; wrong: boolean; onInput: (name: string) => void }) {
  return (
    <div class="field">
      <label for={props.id}>{common.form.accountName}</label>
      <input
        id={props.id}
        type="text"
        autocomplete="off"
        autocapitalize="none"
        spellcheck={false}
        required
        maxLength={200}
        value={props.value}
        aria-invalid={props.wrong}
        aria-describedby={props.answerId}
        onInput={(event) => props.onInput(event.currentTarget.value)}
      />
    </div>
  );
}
