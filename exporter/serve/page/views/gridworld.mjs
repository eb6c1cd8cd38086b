/** Six rooms from above. */

import { GridWorld, SIZE, WALLS } from "../scenes/gridworld.mjs";
import { between, disc, places, rounded } from "./drawing.mjs";

const AGENTS = 6;

const view = {
  name: "GridWorld",
  story: "Each walker (blue) goes to the goal (+) and around the pit (×). Moves into walls are masked. Drag the goal, or click where it is to be.",
  poke: "Move the goals",
  stepSeconds: 0.3,
  agents: AGENTS,
  ratio: (width) => (width < 560 ? 0.72 : 1.55),
  labels: {
    observations: ["own column", "own row", "goal column", "goal row", "pit column", "pit row"],
    branches: [["up", "right", "down", "left"]],
  },
  create: () => new GridWorld(AGENTS),
  players: ["model"],
  observed: (observation) => observation,
  actions: ({ model }) => model,
  count: (tally) => `failed ${tally.bad}`,
  status: (env, tally) => `goals reached ${tally.good}`,
  describe(env, tally, chosen) {
    const cell = ([column, row]) => `column ${column + 1}, row ${row + 1}`;
    return (
      `${AGENTS} rooms of 5 by 5 cells. ${tally.good} goals were reached so far, ${tally.bad} missed. In room ${chosen + 1} the ` +
      `walker is at ${cell(env.agent[chosen])}, the goal at ${cell(env.goal[chosen])}, the pit at ${cell(env.pit[chosen])}.`
    );
  },
  at,
  draw,
};

export const viewOf = () => view;

/** The room and the cell under a point of the canvas. */
function at({ width, height }, after, [x, y], agent) {
  const rooms = places(AGENTS, width, height);
  const room = agent ?? rooms.findIndex((place) => x >= place.x && x < place.x + place.width && y >= place.y && y < place.y + place.width);
  if (room < 0) return null;
  const cell = rooms[room].width / SIZE;
  const inside = (n) => Math.max(0, Math.min(SIZE - 1, Math.floor(n)));
  return { agent: room, place: [inside((x - rooms[room].x) / cell), SIZE - 1 - inside((y - rooms[room].y) / cell)] };
}

function draw(context, { width, height }, before, after, share, colours, chosen) {
  places(AGENTS, width, height).forEach((place, i) => room(context, place, i, before, after, share, colours, i === chosen));
}

function room(context, { x, y, width }, i, before, after, share, colours, isChosen) {
  const cell = width / SIZE;
  const middle = ([column, row]) => [x + (column + 0.5) * cell, y + (SIZE - row - 0.5) * cell]; // row 0 is at the bottom
  rounded(context, x - 4, y - 4, width + 8, width + 8, 10);
  context.fillStyle = colours.paper;
  context.fill();
  context.strokeStyle = isChosen ? colours.accent : colours.rule;
  context.lineWidth = isChosen ? 2.5 : 1;
  context.stroke();
  for (let n = 0; n < SIZE * SIZE; n++) {
    const [column, row] = [n % SIZE, Math.floor(n / SIZE)];
    const isWall = WALLS.some((wall) => wall[0] === column && wall[1] === row);
    rounded(context, x + column * cell + 1.5, y + (SIZE - row - 1) * cell + 1.5, cell - 3, cell - 3, 4);
    context.fillStyle = isWall ? colours.soft : colours.sheet;
    context.fill();
  }
  mark(context, middle(after.goal[i]), cell, colours.good, colours.paper, 0);
  mark(context, middle(after.pit[i]), cell, colours.bad, colours.paper, Math.PI / 4);
  const [ax, ay] = middle(between(before, after, "agent", i, smooth(share)));
  context.fillStyle = colours.accent;
  disc(context, ax, ay, 0.27 * cell);
  context.fill();
  context.strokeStyle = colours.paper;
  context.lineWidth = 2;
  context.stroke();
}

/** A disc with a cross in it; turned by 45° it is an ×. */
function mark(context, [x, y], cell, colour, ink, angle) {
  context.fillStyle = colour;
  disc(context, x, y, 0.36 * cell);
  context.fill();
  context.save();
  context.translate(x, y);
  context.rotate(angle);
  context.strokeStyle = ink;
  context.lineWidth = 0.08 * cell;
  context.lineCap = "round";
  const arm = 0.16 * cell;
  context.beginPath();
  context.moveTo(-arm, 0);
  context.lineTo(arm, 0);
  context.moveTo(0, -arm);
  context.lineTo(0, arm);
  context.stroke();
  context.restore();
}

const smooth = (t) => t * t * (3 - 2 * t);
