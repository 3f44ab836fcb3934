// Offer the other versions of the site, which lie beside this one (docs/versions.py).
document.addEventListener("DOMContentLoaded", () => {
  const versions = window.LAGROS_VERSIONS || [];
  const brand = document.querySelector(".sidebar-brand");
  if (versions.length < 2 || !brand) return;
  const here = DOCUMENTATION_OPTIONS.VERSION;
  const select = document.createElement("select");
  select.setAttribute("aria-label", "Version");
  select.className = "versions";
  for (const version of versions) {
    select.add(new Option(version, version, false, version === here));
  }
  const root = document.documentElement.dataset.content_root || "./";
  select.addEventListener("change", () => {
    window.location.href = `${root}../${select.value}/index.html`;
  });
  brand.after(select);
});
