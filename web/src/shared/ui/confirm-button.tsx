import { useEffect, useRef, useState } from "preact/hooks";
import { sentence } from "../api/http";
import { useReturnFocus } from "../hooks/use-return-focus";

interface ConfirmProps {
  label: string;
  /** The action and its object, for screen readers. */
  description?: string;
  question: string;
  yes: string;
  busy: string;
  keep: string;
  onYes: () => Promise<void>;
  "data-testid"?: string;
}

/** A button for irreversible actions: it asks for confirmation in place and shows errors there. */
export function ConfirmButton({ label, description, question, yes, busy, keep, onYes, ...rest }: ConfirmProps) {
  const [asking, setAsking] = useState(false);
  const [working, setWorking] = useState(false);
  const [wrong, setWrong] = useState("");
  const ask = useReturnFocus(asking);
  const safe = useRef<HTMLButtonElement>(null);

  // The focused button is removed: move the focus to Cancel.
  useEffect(() => {
    if (asking) safe.current?.focus();
  }, [asking]);

  const go = async (): Promise<void> => {
    setWorking(true);
    setWrong("");
    try {
      await onYes();
      setAsking(false);
    } catch (error) {
      setWrong(sentence(error));
    } finally {
      setWorking(false);
    }
  };

  return (
    <div class="confirm">
      {asking ? (
        <div class="row" role="group" aria-label={question}>
          <span>{question}</span>
          <button type="button" class="danger" data-testid="confirm-yes" disabled={working} onClick={() => void go()}>
            {working ? busy : yes}
          </button>
          <button type="button" ref={safe} disabled={working} onClick={() => setAsking(false)}>
            {keep}
          </button>
        </div>
      ) : (
        <button
          type="button"
          class="plain"
          ref={ask}
          aria-label={description}
          onClick={() => {
            setWrong("");
            setAsking(true);
          }}
          {...rest}
        >
          {label}
        </button>
      )}
      {wrong !== "" && (
        <p class="field-error" role="alert">
          {wrong}
        </p>
      )}
    </div>
  );
}
