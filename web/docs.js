// Shows the description of the interface. Nothing is asked of anybody but this server.
"use strict";
SwaggerUIBundle({
  url: "/openapi.json",
  domNode: document.getElementById("docs"),
  deepLinking: true,
  displayRequestDuration: true,
  validatorUrl: null,
});
