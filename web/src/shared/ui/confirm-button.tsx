import { useEffect, useRef, useState } from "preact/hooks";
import { sentence } from "../api/http";
import { useReturnFocus } from "../hooks/use-return-focus";

interface ConfirmProps {
  label: string;
  /** What the button does to what: for who does not see what stands beside it. */
  description?: string;
  question: string;
  yes: string;
  busy: string;
  keep: string;
  onYes: () => Promise<void>;
  "data-testid"?: string;
}

/** A button for what cannot be undone: it asks, in its own place, and says there what went wrong. */
export function ConfirmButton({ label, description, question, yes, busy, keep, onYes, ...rest }: ConfirmProps) {
  const [asking, setAsking] = useState(false);
  const [working, setWorking] = useState(false);
  const [wrong, setWrong] = useState("");
  const ask = useReturnFocus(asking);
  const safe = useRef<HTMLButtonElement>(null);

  // The button that had the focus is gone: it goes to the harmless one.
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
