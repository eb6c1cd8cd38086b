/** Making elements. */

/**
 * `h("label", { for: "x" }, "Seed", input)`. A function under "on…" listens; false and null leave an attribute out,
 * true sets it empty; anything else is an attribute. Children that are null or false are left out.
 */
export function h(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (typeof value === "function") element.addEventListener(name.slice(2), value);
    else if (value !== false && value != null) element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children.flat(Infinity).filter((child) => child != null && child !== false));
  return element;
}

export const $ = (id) => document.getElementById(id);

let made = 0;
export const newId = (what) => `${what}-${++made}`;

/** A number for people: enough digits to see a change, and no more. */
export function text(value, digits = 3) {
  if (value === 0) return "0";
  const size = Math.abs(value);
  if (!Number.isFinite(value)) return Number.isNaN(value) ? "not a number" : value < 0 ? "−∞" : "∞";
  const written = size >= 1e5 || size < 1e-3 ? value.toExponential(1) : value.toFixed(size >= 100 ? 1 : digits);
  return written.replaceAll("-", "−");
}

/** A number with a fixed count of decimals, which does not jump when it changes. */
export function fixed(value, decimals = 3) {
  if (!Number.isFinite(value) || Math.abs(value) >= 1e5) return text(value, decimals);
  return value.toFixed(Math.abs(value) >= 100 ? 1 : decimals).replace(/^-(?=[0.]*$)/, "").replace("-", "−");
}

export const milliseconds = (value) => `${value < 10 ? value.toFixed(2) : value.toFixed(1)} ms`;

export const frame = () => new Promise((resolve) => requestAnimationFrame(resolve));

/** Runs `job` soon, once for all calls until then, and once more if calls came while it ran. */
export function coalesced(job) {
  let [running, again] = [false, false];
  return async function call() {
    if (running) {
      again = true;
      return;
    }
    running = true;
    try {
      do {
        again = false;
        await job();
      } while (again);
    } finally {
      running = false;
    }
  };
}
