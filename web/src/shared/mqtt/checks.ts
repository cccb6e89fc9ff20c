/** Checks of untrusted JSON values. A failed check throws MessageError with the path of the value. */
export const MAX_JOINTS = 128;

/** A message that violates the contract; the text names the field. */
export class MessageError extends Error {
  override name = "MessageError";
}

/**
 * Checks one value; `at` is its path and `key` its position there, for the error text. They are joined only on errors:
 * ten robots publish two hundred messages per second with a hundred numbers each.
 */
export type Check<T> = (value: unknown, at: string, key?: string | number) => T;

export function pathOf(at: string, key?: string | number): string {
  if (key === undefined) return at;
  return typeof key === "number" ? `${at}[${key}]` : `${at}.${key}`;
}

export function fail(at: string, expected: string, key?: string | number): never {
  throw new MessageError(`${pathOf(at, key)} is not ${expected}`);
}

export const number: Check<number> = (value, at, key) =>
  typeof value === "number" && Number.isFinite(value) ? value : fail(at, "a finite number", key);

export const count: Check<number> = (value, at, key) =>
  Number.isSafeInteger(value) && (value as number) >= 0 ? (value as number) : fail(at, "a whole number from 0", key);

export const text: Check<string> = (value, at, key) => (typeof value === "string" ? value : fail(at, "text", key));

export const flag: Check<boolean> = (value, at, key) => (typeof value === "boolean" ? value : fail(at, "true or false", key));

export const record: Check<Record<string, unknown>> = (value, at, key) =>
  typeof value === "object" && value !== null && !Array.isArray(value)
    ? (value as Record<string, unknown>)
    : fail(at, "an object", key);

export function oneOf<const T extends string>(...names: T[]): Check<T> {
  return (value, at, key) => {
    const found = names.find((name) => name === value);
    return found ?? fail(at, `one of ${names.join(", ")}`, key);
  };
}

export function list<T>(item: Check<T>, longest: number): Check<T[]> {
  return (value, at, key) => {
    if (!Array.isArray(value) || value.length > longest) fail(at, `a list of at most ${longest}`, key);
    const here = pathOf(at, key);
    return value.map((entry, index) => item(entry, here, index));
  };
}

/** Numbers by name, without the object prototype's properties. */
export const byName: Check<Record<string, number>> = (value, at, key) => {
  const entries = Object.entries(record(value, at, key));
  if (entries.length > MAX_JOINTS) fail(at, `at most ${MAX_JOINTS} numbers`, key);
  const here = pathOf(at, key);
  return Object.fromEntries(entries.map(([name, entry]) => [name, number(entry, here, name)]));
};

export function numbers<T extends number[]>(length: T["length"]): Check<T> {
  return (value, at, key) => {
    if (!Array.isArray(value) || value.length !== length) fail(at, `${length} numbers`, key);
    const here = pathOf(at, key);
    return value.map((entry, index) => number(entry, here, index)) as T;
  };
}

export function optional<T>(check: Check<T>, otherwise: T): Check<T> {
  return (value, at, key) => (value === undefined ? otherwise : check(value, at, key));
}

export function nullable<T>(check: Check<T>): Check<T | null> {
  return (value, at, key) => (value === undefined || value === null ? null : check(value, at, key));
}

type Fields<T> = { [K in keyof T]-?: Check<T[K]> };

export function object<T extends object>(fields: Fields<T>): Check<T> {
  const entries = Object.entries<Check<unknown>>(fields as Record<string, Check<unknown>>);
  return (value, at, key) => {
    const values = record(value, at, key);
    const here = pathOf(at, key);
    return Object.fromEntries(entries.map(([name, check]) => [name, check(values[name], here, name)])) as T;
  };
}
