import { useEffect, useRef, useState } from "preact/hooks";
import { sentence } from "../api/http";
import { useReturnFocus } from "../hooks/use-return-focus";

interface ConfirmProps {
  label: string;
  /** The action and its object, for screen readers. */
  description?: string;
  question: string;
  confirmLabel: string;
  busyLabel: string;
  cancelLabel: string;
  onConfirm: () => Promise<void>;
  "data-testid"?: string;
}

/** A button for irreversible actions: it asks for confirmation in place and shows errors there. */
export function ConfirmButton({ label, description, question, confirmLabel, busyLabel, cancelLabel, onConfirm, ...rest }: ConfirmProps) {
  const [confirming, setConfirming] = useState(false);
  const [working, setWorking] = useState(false);
  const [error, setError] = useState("");
  const openButton = useReturnFocus(confirming);
  const cancelButton = useRef<HTMLButtonElement>(null);

  // The focused button is removed: move the focus to Cancel.
  useEffect(() => {
    if (confirming) cancelButton.current?.focus();
  }, [confirming]);

  const confirm = async (): Promise<void> => {
    setWorking(true);
    setError("");
    try {
      await onConfirm();
      setConfirming(false);
    } catch (error) {
      setError(sentence(error));
    } finally {
      setWorking(false);
    }
  };

  return (
    <div class="confirm">
      {confirming ? (
        <div class="row" role="group" aria-label={question}>
          <span>{question}</span>
          <button type="button" class="danger" data-testid="confirm-yes" disabled={working} onClick={() => void confirm()}>
            {working ? busyLabel : confirmLabel}
          </button>
          <button type="button" ref={cancelButton} disabled={working} onClick={() => setConfirming(false)}>
            {cancelLabel}
          </button>
        </div>
      ) : (
        <button
          type="button"
          class="plain"
          ref={openButton}
          aria-label={description}
          onClick={() => {
            setError("");
            setConfirming(true);
          }}
          {...rest}
        >
          {label}
        </button>
      )}
      {error !== "" && (
        <p class="field-error" role="alert">
          {error}
        </p>
      )}
    </div>
  );
}
