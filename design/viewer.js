// The interactive view of the flow: grains and baffles in an orthographic projection on a canvas.
// Every figure.flow of the page holds its own data as JSON; no library and no network.
"use strict";
(() => {
  const SHADES = 16;

  function decode(base64, count) {
    const bytes = Uint8Array.from(atob(base64), (c) => c.charCodeAt(0));
    const view = new DataView(bytes.buffer);
    const out = new Float32Array(count);
    for (let i = 0; i < count; i++) out[i] = view.getUint16(2 * i, true) / 65535;
    return out;
  }

  // A flow with its positions in metres, frame after frame, and the speed of every grain.
  function unpack(flow, scene, times) {
    const n = flow.grains, frames = times.length, dim = 3;
    const p = decode(flow.positions, frames * n * dim);
    for (let i = 0; i < p.length; i++) {
      const axis = i % dim;
      p[i] = scene.lower[axis] + p[i] * (scene.upper[axis] - scene.lower[axis]);
    }
    const speed = new Float32Array(frames * n);
    for (let k = 0; k < frames; k++) {
      const a = Math.max(k - 1, 0), b = Math.min(k + 1, frames - 1);
      const dt = Math.max(times[b] - times[a], 1e-9);
      for (let i = 0; i < n; i++) {
        const s = dim * (a * n + i), e = dim * (b * n + i);
        speed[k * n + i] = Math.hypot(p[e] - p[s], p[e + 1] - p[s + 1], p[e + 2] - p[s + 2]) / dt;
      }
    }
    return { ...flow, p, speed };
  }

  function start(figure) {
    const data = JSON.parse(figure.querySelector("script").textContent);
    const { scene, times, fastest } = data;
    const flows = data.flows.map((flow) => unpack(flow, scene, times));
    const canvases = [...figure.querySelectorAll("canvas")];
    const slider = figure.querySelector("input");
    const clock = figure.querySelector("output");
    const play = figure.querySelector("button");
    const tops = [scene.upper[0], scene.top, scene.upper[2]];
    const middle = tops.map((t, a) => (scene.lower[a] + t) / 2);
    const size = tops.map((t, a) => t - scene.lower[a]);
    const camera = { yaw: scene.flat ? 0 : 0.5, pitch: scene.flat ? 0 : 0.6, zoom: 1 };

    const css = (name) => getComputedStyle(figure).getPropertyValue(name).trim();
    function rgb(text) {
      const n = parseInt(text.slice(1), 16);
      return [n >> 16, (n >> 8) & 255, n & 255];
    }
    const mix = (a, b, t) =>
      `rgb(${a.map((v, i) => Math.round(v + (b[i] - v) * t)).join(",")})`;

    function draw() {
      const frame = Number(slider.value);
      clock.value = `t = ${times[frame].toFixed(2)} s`;
      slider.setAttribute("aria-valuetext", clock.value);
      flows.forEach((flow, k) => {
        paint(canvases[k], flow, frame);
        const panel = canvases[k].parentElement;
        for (const cell of panel.querySelectorAll("[data-measure]")) {
          cell.textContent = flow.numbers[cell.dataset.measure][frame];
        }
      });
    }

    function paint(canvas, flow, frame) {
      const ratio = window.devicePixelRatio || 1;
      const width = canvas.clientWidth, height = canvas.clientHeight;
      if (!width) return;
      canvas.width = width * ratio;
      canvas.height = height * ratio;
      const c = canvas.getContext("2d");
      c.scale(ratio, ratio);
      const cy = Math.cos(camera.yaw), sy = Math.sin(camera.yaw);
      const cp = Math.cos(camera.pitch), sp = Math.sin(camera.pitch);
      const span = scene.flat ? 0 : size[2];
      const wide = size[0] * Math.abs(cy) + span * Math.abs(sy);
      const deep = size[0] * Math.abs(sy) + span * Math.abs(cy);
      const scale = camera.zoom * Math.min(
        (width - 12) / wide, (height - 12) / (size[1] * cp + deep * sp));
      const depth = (x, y, z) => y * sp + (-x * sy + z * cy) * cp;
      const project = (q) => {
        const x = q[0] - middle[0], y = q[1] - middle[1], z = q[2] - middle[2];
        return [width / 2 + scale * (x * cy + z * sy),
                height / 2 - scale * (y * cp - (-x * sy + z * cy) * sp)];
      };
      const polygon = (corners, fill, stroke) => {
        c.beginPath();
        corners.map(project).forEach(([u, v], i) => (i ? c.lineTo(u, v) : c.moveTo(u, v)));
        c.closePath();
        if (fill) { c.fillStyle = fill; c.fill(); }
        if (stroke) { c.save(); c.strokeStyle = stroke; c.stroke(); c.restore(); }
      };
      const line = (a, b, dash) => {
        c.setLineDash(dash);
        c.beginPath();
        c.moveTo(...project(a));
        c.lineTo(...project(b));
        c.stroke();
        c.setLineDash([]);
      };

      // The base, and on it the control section.
      const [x0, y0, z0] = scene.lower, [x1, , z1] = scene.upper;
      c.lineWidth = 1;
      polygon([[x0, y0, z0], [x1, y0, z0], [x1, y0, z1], [x0, y0, z1]], css("--ground"), css("--line"));
      c.strokeStyle = css("--muted");
      if (scene.flat) line([scene.section, y0, z0], [scene.section, scene.top, z0], [2, 4]);
      else line([scene.section, y0, z0], [scene.section, y0, z1], [2, 4]);

      // Boxes from back to front. A grain is in front of a box if it lies beyond one of the faces
      // that we see: exact for convex boxes that no grain is inside of.
      // A box is turned about the vertical through its middle: `own` sees a point in the frame in
      // which it is not.
      const boxes = flow.baffles
        .map(([low, high, [cosine, sine]]) => {
          const mid = low.map((l, a) => (l + high[a]) / 2);
          const turn = (q, s) => {
            const x = q[0] - mid[0], z = q[2] - mid[2];
            return [mid[0] + cosine * x - s * z, q[1], mid[2] + s * x + cosine * z];
          };
          return {
            low, high, far: depth(...mid),
            own: (q) => (sine ? turn(q, -sine) : q),
            world: (q) => (sine ? turn(q, sine) : q),
            normal: [depth(cosine, 0, sine), depth(0, 1, 0), depth(-sine, 0, cosine)],
          };
        })
        .sort((a, b) => a.far - b.far);
      const n = flow.grains, offset = frame * n;
      const layer = new Uint8Array(n), far = new Float32Array(n);
      for (let i = 0; i < n; i++) {
        const q = 3 * (offset + i);
        far[i] = depth(flow.p[q], flow.p[q + 1], flow.p[q + 2]);
        const grain = [flow.p[q], flow.p[q + 1], flow.p[q + 2]];
        boxes.forEach((box, b) => {
          const seen = box.own(grain);
          for (let a = 0; a < 3; a++) {
            const v = seen[a], toward = box.normal[a];
            if ((toward > 1e-6 && v >= box.high[a]) || (toward < -1e-6 && v <= box.low[a])) {
              layer[i] = b + 1;
            }
          }
        });
      }
      const order = Uint32Array.from({ length: n }, (_, i) => i)
        .sort((a, b) => layer[a] - layer[b] || far[a] - far[b]);
      const slow = rgb(css("--rest")), quick = rgb(css("--quick"));
      const colours = Array.from({ length: SHADES }, (_, s) => mix(slow, quick, s / (SHADES - 1)));
      const radius = Math.max(0.7, 0.55 * flow.size * scale);
      c.strokeStyle = "rgba(0, 0, 0, 0.28)";
      c.lineWidth = 0.5;
      let next = 0;
      for (let b = 0; b <= boxes.length; b++) {
        for (; next < n && layer[order[next]] === b; next++) {
          const i = order[next], q = 3 * (offset + i);
          const [u, v] = project([flow.p[q], flow.p[q + 1], flow.p[q + 2]]);
          const share = Math.min(flow.speed[offset + i] / fastest, 1);
          c.fillStyle = colours[Math.round(share * (SHADES - 1))];
          c.beginPath();
          c.arc(u, v, radius, 0, 6.2832);
          c.fill();
          if (radius > 2) c.stroke();
        }
        if (b < boxes.length) solid(boxes[b], flow.colour);
      }

      function solid({ low, high, normal, world }, colour) {
        const paint = rgb(css(colour)), dark = [0, 0, 0], light = [255, 255, 255];
        const shade = [mix(paint, dark, 0.22), mix(paint, light, 0.22), mix(paint, dark, 0.06)];
        for (let a = 0; a < 3; a++) {
          if (Math.abs(normal[a]) < 1e-6) continue;
          const at = normal[a] > 0 ? high[a] : low[a], u = (a + 1) % 3, v = (a + 2) % 3;
          const corner = (p, q) => {
            const r = [0, 0, 0];
            r[a] = at; r[u] = p; r[v] = q;
            return world(r);
          };
          polygon([corner(low[u], low[v]), corner(high[u], low[v]),
                   corner(high[u], high[v]), corner(low[u], high[v])], shade[a], shade[a]);
        }
      }
    }

    let timer = null;
    function stop() {
      clearInterval(timer);
      timer = null;
      play.textContent = "Play";
    }
    play.addEventListener("click", () => {
      if (timer) return stop();
      if (Number(slider.value) >= times.length - 1) slider.value = 0;
      play.textContent = "Pause";
      timer = setInterval(() => {
        slider.value = Number(slider.value) + 1;
        draw();
        if (Number(slider.value) >= times.length - 1) stop();
      }, 80);
    });
    slider.addEventListener("input", () => { if (timer) stop(); draw(); });
    for (const canvas of canvases) {
      canvas.addEventListener("pointerdown", (e) => canvas.setPointerCapture(e.pointerId));
      canvas.addEventListener("pointermove", (e) => {
        if (!e.buttons) return;
        camera.yaw += 0.008 * e.movementX;
        camera.pitch = Math.min(1.57, Math.max(0, camera.pitch + 0.008 * e.movementY));
        draw();
      });
      canvas.addEventListener("wheel", (e) => {
        if (!e.ctrlKey && !e.shiftKey) return;  // a plain wheel scrolls the page
        e.preventDefault();
        camera.zoom = Math.min(8, Math.max(0.5, camera.zoom * Math.exp(-0.002 * (e.deltaY || e.deltaX))));
        draw();
      }, { passive: false });
      canvas.addEventListener("dblclick", () => { camera.zoom = 1; draw(); });
    }
    window.addEventListener("resize", draw);
    window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
    draw();
    figure.dataset.ready = "yes";
  }
  document.querySelectorAll("figure.flow").forEach(start);
})();
