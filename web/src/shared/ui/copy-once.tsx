import { useRef, useState } from "preact/hooks";
import { common } from "../i18n/common";

interface SecretProps {
  id: string;
  label: string;
  value: string;
}

/** A secret that is shown once, with a copy button. */
export function CopyOnce({ id, label, value }: SecretProps) {
  const field = useRef<HTMLInputElement>(null);
  const [message, setMessage] = useState("");
  const copy = async (): Promise<void> => {
    try {
      await navigator.clipboard.writeText(value);
      setMessage(common.copy.copied);
    } catch {
      // Browsers deny clipboard access on insecure origins.
      field.current?.focus();
      field.current?.select();
      setMessage(common.copy.manually);
    }
  };
  return (
    <div class="secret">
      <label for={id}>{label}</label>
      <div class="row">
        <input
          id={id}
          ref={field}
          data-testid={id}
          type="text"
          readOnly
          spellcheck={false}
          value={value}
          onFocus={(event) => event.currentTarget.select()}
        />
        <button type="button" class="primary" data-testid={`${id}-copy`} onClick={() => void copy()}>
          {common.copy.button}
        </button>
      </div>
      <p class="field-note" role="status">
        {message}
      </p>
    </div>
  );
}
