document.addEventListener("DOMContentLoaded", () => {
  // What the theme leaves out for readers by keyboard and by ear.
  document.querySelector(".md-search")?.setAttribute("aria-label", "Search");
  for (const code of document.querySelectorAll("pre > code")) code.tabIndex = 0;
  // The tags that pymdownx.arithmatex puts around equations.
  for (const element of document.querySelectorAll(".arithmatex")) {
    renderMathInElement(element, {
      delimiters: [
        { left: "\\(", right: "\\)", display: false },
        { left: "\\[", right: "\\]", display: true },
      ],
      throwOnError: true,
    });
  }
  // What scrolls sideways on a narrow page can be reached by keyboard.
  const wide = document.querySelectorAll(".md-typeset__scrollwrap, .figure, .katex-display");
  const reachable = () => {
    for (const part of wide) {
      if (part.scrollWidth > part.clientWidth) part.tabIndex = 0;
      else part.removeAttribute("tabindex");
    }
  };
  addEventListener("load", reachable);
  addEventListener("resize", reachable);
});
