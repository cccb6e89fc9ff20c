/** An inline form: fields, submit and cancel buttons, and a result message. */
import type { ComponentChildren, Ref } from "preact";
import { common } from "../i18n/common";

interface InlineFormProps {
  label: string;
  /** Labels of the submit button: idle and busy. */
  submitLabel: string;
  busyLabel: string;
  busy: boolean;
  cancelLabel?: string;
  /** Empty without a message. */
  error: string;
  successMessage?: string;
  /** Id of the message, for `aria-describedby` of invalid fields. */
  messageId?: string;
  form?: Ref<HTMLFormElement>;
  submitTestId?: string;
  onSubmit: () => Promise<void>;
  onClose: () => void;
  children: ComponentChildren;
}

export function InlineForm({ label, submitLabel, busyLabel, busy, error, successMessage = "", onSubmit, onClose, children, ...rest }: InlineFormProps) {
  return (
    <form
      class="panel fields"
      ref={rest.form}
      aria-label={label}
      onSubmit={(event) => {
        event.preventDefault();
        void onSubmit();
      }}
    >
      {children}
      <div class="row">
        <button type="submit" class="primary" data-testid={rest.submitTestId} disabled={busy}>
          {busy ? busyLabel : submitLabel}
        </button>
        <button type="button" disabled={busy} onClick={onClose}>
          {rest.cancelLabel ?? common.form.cancel}
        </button>
      </div>
      <p id={rest.messageId} class={error === "" ? "field-note" : "field-error"} aria-live="polite">
        {error === "" ? successMessage : error}
      </p>
    </form>
  );
}

/** The recipient's account name. If `invalid`, the form message `messageId` contains the error. */
export function AccountNameField(props: { id: string; messageId: string; value: string; invalid: boolean; onInput: (name: string) => void }) {
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
        aria-invalid={props.invalid}
        aria-describedby={props.messageId}
        onInput={(event) => props.onInput(event.currentTarget.value)}
      />
    </div>
  );
}
