/** Polls the cloud while the page is visible. */
import { useCallback, useEffect, useRef, useState } from "preact/hooks";
import { sentence } from "../api/http";

export interface Polled<T> {
  /** The newest answer; `null` before the first. */
  value: T | null;
  /** Why the last one did not come; empty otherwise. What came before stays. */
  trouble: string;
  /** Ask now. */
  again: () => void;
}

/** Ask every so often, and whenever one of `keys` changes, which also forgets what was known. */
export function usePolling<T>(load: () => Promise<T>, everyMs: number, keys: readonly unknown[]): Polled<T> {
  const [value, setValue] = useState<T | null>(null);
  const [trouble, setTrouble] = useState("");
  const asked = useRef(0);
  const newest = useRef(load);
  newest.current = load;
  const again = useCallback(() => {
    const mine = ++asked.current;
    newest.current().then(
      (found) => {
        if (mine !== asked.current) return;
        setValue(found);
        setTrouble("");
      },
      (error: unknown) => mine === asked.current && setTrouble(sentence(error)),
    );
  }, []);
  useEffect(() => {
    setValue(null);
    again();
    const timer = setInterval(() => {
      if (document.visibilityState === "visible") again();
    }, everyMs);
    return () => {
      clearInterval(timer);
      asked.current += 1;
    };
  }, [again, everyMs, ...keys]);
  return { value, trouble, again };
}
