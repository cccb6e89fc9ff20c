/** Parameter fields of a movement, each with its error. */
import { useId, useMemo, useState } from "preact/hooks";
import { storedParameters } from "../../shared/lib/local-storage";
import type { ObjectSchema, Parameters } from "../../shared/api/movement-library";
import { fieldsOf, initialTexts, read, type Field, type FieldTexts, type FieldError } from "./model/parameter-form";
import { texts } from "./texts";
import { storage } from "../../shared/hooks/browser-storage";

interface ParameterValues {
  fields: readonly Field[];
  filled: FieldTexts;
  error: Readonly<Record<string, FieldError>>;
  set: (name: string, text: string) => void;
  /** Restores the defaults. */
  reset: () => void;
  /** Returns the values and stores them as last used; `null` if one is invalid, which is shown from then on. */
  submit: () => Parameters | null;
}

/** The parameter values of one movement, initially those used last. */
export function useParameters(
  account: string,
  robotType: string,
  movement: string,
  schema: ObjectSchema | null,
): ParameterValues {
  const shape = JSON.stringify(schema);
  const fields = useMemo(() => fieldsOf(JSON.parse(shape) as ObjectSchema | null), [shape]);
  const stored = useMemo(() => storedParameters(storage(), account, robotType, movement), [account, robotType, movement]);
  const [typed, setTyped] = useState<FieldTexts>({});
  const [submitted, setSubmitted] = useState(false);
  const start = useMemo(() => initialTexts(fields, stored.read() ?? {}), [fields, stored]);
  const filled = { ...start, ...typed };
  const { values, errors } = read(fields, filled);
  return {
    fields,
    filled,
    error: submitted ? errors : Object.fromEntries(Object.entries(errors).filter(([name]) => name in typed)),
    set: (name, text) => setTyped({ ...typed, [name]: text }),
    reset: () => {
      setTyped(initialTexts(fields));
      setSubmitted(false);
    },
    submit: () => {
      setSubmitted(true);
      if (Object.keys(errors).length > 0) return null;
      if (fields.length > 0) stored.write(values);
      return values;
    },
  };
}

export function ParameterFields({ values, disabled }: { values: ParameterValues; disabled?: boolean }) {
  if (values.fields.length === 0) return <p class="quiet">{texts.parameters.none}</p>;
  return (
    <div class="parameters">
      {values.fields.map((field) => (
        <ParameterField
          key={field.name}
          field={field}
          text={values.filled[field.name] ?? ""}
          error={values.error[field.name] ?? null}
          disabled={disabled ?? false}
          onText={(text) => values.set(field.name, text)}
        />
      ))}
    </div>
  );
}

interface ParameterFieldProps {
  field: Field;
  text: string;
  error: FieldError | null;
  disabled: boolean;
  onText: (text: string) => void;
}

function ParameterField({ field, text, error, disabled, onText }: ParameterFieldProps) {
  const id = useId();
  const attributes = {
    id,
    disabled,
    "aria-invalid": error !== null,
    "aria-describedby": `${id}-note`,
    "data-testid": `parameter-${field.name}`,
  };
  const onInput = (event: { currentTarget: { value: string } }): void => onText(event.currentTarget.value);
  const range = texts.parameters.range(field.min, field.max, field.unit);
  return (
    <div class={`field ${field.kind === "yes-no" ? "yes-no" : ""}`}>
      <label for={id}>
        {field.title}
        {field.unit !== "" && <span class="quiet"> [{field.unit}]</span>}
        {!field.required && field.kind !== "yes-no" && field.schema.default === undefined && (
          <span class="quiet"> {texts.parameters.optional}</span>
        )}
      </label>
      {field.kind === "yes-no" ? (
        <input
          type="checkbox"
          {...attributes}
          checked={text === "true"}
          onChange={(event) => onText(String(event.currentTarget.checked))}
        />
      ) : field.kind === "choice" ? (
        <select {...attributes} value={text} onChange={onInput}>
          {text === "" && <option value="">{texts.parameters.choose}</option>}
          {field.choices.map((choice) => (
            <option key={choice} value={choice}>
              {choice}
            </option>
          ))}
        </select>
      ) : (
        <input
          type="text"
          {...attributes}
          inputMode={field.kind === "number" || field.kind === "integer" ? "decimal" : undefined}
          autocomplete="off"
          value={text}
          onInput={onInput}
        />
      )}
      <p id={`${id}-note`} class={error === null ? "quiet small" : "field-error"}>
        {error === null
          ? [field.description, range, texts.parameters.hints[field.kind]].filter((one) => one !== "").join(" · ")
          : texts.parameters.error(error, field.unit)}
      </p>
    </div>
  );
}
