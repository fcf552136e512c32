import { defineConfig } from "vite";

// Fixed names: the program embeds these three files. Relative addresses: the token is a part of the path.
export default defineConfig({
  base: "./",
  build: {
    outDir: "../assets",
    emptyOutDir: true,
    modulePreload: false,
    assetsInlineLimit: 0,
    target: "es2022",
    rollupOptions: {
      output: {
        entryFileNames: "lab.js",
        chunkFileNames: "lab-[name].js",
        assetFileNames: "lab[extname]",
      },
    },
  },
});
