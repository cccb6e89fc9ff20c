/** Polls the cloud while the page is visible. */
import { useCallback, useEffect, useRef, useState } from "preact/hooks";
import { sentence } from "../api/http";

export interface Polled<T> {
  /** The newest response; `null` before the first. */
  value: T | null;
  /** The error of the last call, or "". The previous response stays. */
  trouble: string;
  /** Polls immediately. */
  again: () => void;
}

/** Polls at an interval, and when one of `keys` changes, which also clears the last response. */
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
