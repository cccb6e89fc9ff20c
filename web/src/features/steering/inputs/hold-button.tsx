import type { ComponentChildren } from "preact";
import { useEffect } from "preact/hooks";
import type { PressedInputs } from "../model/pressed-inputs";

interface HoldButtonProps<T> {
  inputs: PressedInputs<T>;
  name: string;
  part: T;
  label: string;
  disabled: boolean;
  class?: string;
  children: ComponentChildren;
}

/** Active while held with the pointer, Space or Enter. Losing the pointer or the focus releases it. */
export function HoldButton<T>({ inputs, name, part, label, disabled, children, ...rest }: HoldButtonProps<T>) {
  useEffect(() => () => inputs.release(name), [inputs, name]);
  const release = (): void => inputs.release(name);
  return (
    <button
      type="button"
      class={`hold ${rest.class ?? ""}`}
      data-testid={`hold-${name}`}
      aria-label={label}
      title={label}
      disabled={disabled}
      onPointerDown={(event) => {
        if (event.button !== 0) return;
        event.currentTarget.setPointerCapture(event.pointerId);
        inputs.press(name, part);
      }}
      onPointerUp={release}
      onPointerCancel={release}
      onLostPointerCapture={release}
      onBlur={release}
      onContextMenu={(event) => event.preventDefault()}
      onKeyDown={(event) => {
        if (event.key !== " " && event.key !== "Enter") return;
        event.preventDefault();
        if (!event.repeat) inputs.press(name, part);
      }}
      onKeyUp={(event) => {
        if (event.key === " " || event.key === "Enter") release();
      }}
    >
      {children}
    </button>
  );
}
