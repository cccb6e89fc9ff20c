import { useState } from "preact/hooks";
import { sentence } from "../../shared/api/http";
import { texts } from "./texts";

interface CodeFormProps {
  id: string;
  label: string;
  submit: string;
  /** Not possible: a new app has no recovery codes yet. */
  appOnly?: boolean;
  danger?: boolean;
  onSubmit: (code: string) => Promise<void>;
  onCancel: () => void;
}

/** Asks for a code of the second factor. Errors of `onSubmit` are shown; the input stays. */
export function CodeForm({ id, label, submit, appOnly, danger, onSubmit, onCancel }: CodeFormProps) {
  const [code, setCode] = useState("");
  const [busy, setBusy] = useState(false);
  const [error, setError] = useState("");
  const send = async (): Promise<void> => {
    setBusy(true);
    setError("");
    try {
      await onSubmit(code);
    } catch (error) {
      setError(sentence(error));
      setBusy(false);
    }
  };
  return (
    <form
      class="row-form"
      onSubmit={(event) => {
        event.preventDefault();
        void send();
      }}
    >
      <label for={id}>{label}</label>
      <div class="row">
        <input
          id={id}
          data-testid={id}
          type="text"
          inputMode={appOnly === true ? "numeric" : "text"}
          autocomplete="one-time-code"
          autocapitalize="none"
          spellcheck={false}
          required
          maxLength={40}
          value={code}
          aria-invalid={error !== ""}
          aria-describedby={`${id}-error`}
          onInput={(event) => setCode(event.currentTarget.value)}
        />
        <button type="submit" class={danger === true ? "danger" : "primary"} data-testid={`${id}-submit`} disabled={busy}>
          {submit}
        </button>
        <button type="button" class="plain" disabled={busy} onClick={onCancel}>
          {texts.factor.cancel}
        </button>
      </div>
      <p id={`${id}-error`} class="field-error" aria-live="polite">
        {error}
      </p>
    </form>
  );
}
