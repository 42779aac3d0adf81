"use strict";
(async () => {
  const root = document.documentElement;
  const notice = (text) => {
    const box = document.getElementById("notice");
    box.textContent = text;
    box.hidden = false;
    root.dataset.plots = "none";
  };
  if (typeof DecompressionStream === "undefined") {
    notice("Turning and zooming the plots needs a newer browser (Chrome or Edge 80, Firefox 113, Safari 16.4).");
    return;
  }
  const inflate = async (id) => {
    const bytes = Uint8Array.from(atob(document.getElementById(id).textContent.trim()), (c) => c.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    return new Response(stream).text();
  };
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  const touch = window.matchMedia("(pointer: coarse)").matches;
  const style = (name) => getComputedStyle(root).getPropertyValue(name).trim();
  const axes = (layout) => Object.keys(layout).filter((key) => /^[xy]axis\d*$/.test(key));
  const narrow = () => window.innerWidth < 640;

  // Colours of text, grids and lines come from the page, so that light and dark agree with it.
  const dressed = (layout) => {
    const [ink, soft, rule, paper] = ["--ink", "--soft", "--rule", "--paper"].map(style), small = narrow();
    const out = { ...layout, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)" };
    out.font = { family: getComputedStyle(document.body).fontFamily, size: small ? 11 : 12.5, color: ink };
    out.hoverlabel = { bgcolor: paper, bordercolor: rule, font: { color: ink } };
    out.modebar = { bgcolor: "rgba(0,0,0,0)", color: soft, activecolor: ink };
    out.legend = { ...out.legend, bgcolor: "rgba(0,0,0,0)" };
    const axis = (old) => ({
      ...old, gridcolor: old.showgrid === false ? undefined : rule, zerolinecolor: soft, linecolor: rule,
      tickfont: { color: soft }, automargin: true,
    });
    for (const key of axes(out)) out[key] = axis(out[key]);
    if (out.scene) {
      out.scene = { ...out.scene, bgcolor: "rgba(0,0,0,0)" };
      for (const key of ["xaxis", "yaxis", "zaxis"]) {
        out.scene[key] = { ...out.scene[key], gridcolor: rule, zerolinecolor: rule, color: soft };
      }
      if (small) {
        const { x, y, z } = out.scene.camera.eye;
        out.scene.camera = { ...out.scene.camera, eye: { x: 1.4 * x, y: 1.4 * y, z: 1.4 * z } };
        out.height = Math.min(out.height, Math.round(0.62 * window.innerHeight));
      }
    } else {
      // a finger scrolls the page; a mouse zooms
      out.dragmode = touch ? false : "zoom";
      if (small && out.yaxis?.scaleanchor) out.height = Math.min(out.height, Math.round(0.8 * window.innerWidth) + 50);
      if (small) out.margin = { ...out.margin, l: 48, r: Math.min(out.margin.r, 46) };
    }
    return out;
  };

  let library, figures;
  try {
    [library, figures] = await Promise.all([inflate("library"), inflate("figures")]);
    const script = document.createElement("script");
    script.textContent = library;
    document.head.append(script);
    figures = JSON.parse(figures);
  } catch (error) {
    notice(`The plots that can be turned and zoomed could not be unpacked (${error}).`);
    return;
  }
  const plots = [...document.querySelectorAll(".plot")];
  const config = {
    responsive: true, displaylogo: false, displayModeBar: touch ? false : "hover", doubleClick: "reset",
  };
  const buttons = (layout) => layout.scene
    ? [["toImage", "orbitRotation", "tableRotation", "pan3d", "resetCameraDefault3d"]]
    : [["toImage", "zoom2d", "pan2d", "resetScale2d"]];
  const failed = [];
  for (const div of plots) {
    const figure = figures[div.dataset.figure];
    try {
      div.classList.add("drawn"); // it takes the place of the still picture beside it
      await Plotly.newPlot(div, figure.data, dressed(figure.layout), { ...config, modeBarButtons: buttons(figure.layout) });
    } catch (error) {
      failed.push(error);
      div.classList.remove("drawn");
    }
    await new Promise((resume) => setTimeout(resume));
  }
  dark.addEventListener("change", () => {
    for (const div of plots) {
      const figure = figures[div.dataset.figure];
      const camera = div.layout?.scene?.camera;
      const layout = dressed(figure.layout);
      if (camera) layout.scene.camera = camera;
      Plotly.react(div, figure.data, layout);
    }
  });
  if (failed.length) notice(`${failed.length} plots cannot be turned and zoomed here (${failed[0]}).`);
  root.dataset.plots = failed.length ? "failed" : "drawn";
})();
