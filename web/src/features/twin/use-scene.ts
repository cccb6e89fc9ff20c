import { useEffect, useRef, useState } from "preact/hooks";
import type { RefObject } from "preact";
import type { KnownTwin } from "../../shared/mqtt/parse-messages";
import { texts } from "./texts";
import type { LiveScene } from "./scene";
import { onColourChange } from "../../shared/ui/canvas-theme";

interface SceneView {
  canvas: RefObject<HTMLCanvasElement | null>;
  /** The element with the frame counter `data-frames`. */
  box: RefObject<HTMLDivElement | null>;
  scene: LiveScene | null;
  error: "no-webgl" | "failed" | null;
  /** The error, or "". */
  errorText: string;
}

/** A twin's scene on a canvas, loaded when visible. */
export function useScene(twin: KnownTwin | null): SceneView {
  const canvas = useRef<HTMLCanvasElement>(null);
  const box = useRef<HTMLDivElement>(null);
  const [scene, setScene] = useState<LiveScene | null>(null);
  const [error, setError] = useState<SceneView["error"]>(null);

  useEffect(() => {
    if (twin === null) return;
    let active = true;
    let created: LiveScene | null = null;
    let frames = 0;
    const start = async (): Promise<void> => {
      try {
        const { createScene, NoWebglError } = await import("./scene");
        if (!active || canvas.current === null) return;
        try {
          created = createScene(canvas.current, twin, () => {
            frames += 1;
            box.current?.setAttribute("data-frames", String(frames));
          });
          setScene(created);
          setError(null);
        } catch (error) {
          setError(error instanceof NoWebglError ? "no-webgl" : "failed");
        }
      } catch {
        setError("failed");
      }
    };
    void start();
    const unsubscribe = onColourChange(() => created?.recolour());
    return () => {
      active = false;
      unsubscribe();
      created?.dispose();
      setScene(null);
    };
  }, [twin]);

  const errorText = error === null ? "" : error === "no-webgl" ? texts.view.noWebgl : texts.view.failed;
  return { canvas, box, scene, error, errorText };
}
