// Switches a laser by serial lines, 115200 baud: hello | on | off | code BIT_MS WORD [EVERY_MS]
// Protocol: tapetum.record.blinker. The laser's enable input (TTL) at LASER; off until told otherwise.
const int LASER = 13;
char line[128], word[65];
unsigned long bitMs = 0, everyMs = 0, begun = 0;
int length = 0, filled = 0;

void setup() {
  pinMode(LASER, OUTPUT);
  digitalWrite(LASER, LOW);
  Serial.begin(115200);
}

void steady(bool on) { length = 0; digitalWrite(LASER, on ? HIGH : LOW); }

void obey() {
  unsigned long bit = 0, every = 0;
  char bits[65];
  if (!strcmp(line, "hello")) Serial.println("ok tapetum-blinker 1");
  else if (!strcmp(line, "on")) { steady(true); Serial.println("ok on"); }
  else if (!strcmp(line, "off")) { steady(false); Serial.println("ok off"); }
  else if (sscanf(line, "code %lu %64[01] %lu", &bit, bits, &every) >= 2 && bit > 0 && strlen(bits) > 1
           && (every == 0 || every >= bit * strlen(bits))) {
    strcpy(word, bits); length = strlen(word); bitMs = bit; everyMs = every; begun = millis();
    Serial.println("ok code");
  } else Serial.println("error: hello, on, off, or code BIT_MS WORD [EVERY_MS]");
}

void loop() {
  while (Serial.available()) {
    char next = Serial.read();
    if (next == '\n') { line[filled] = 0; filled = 0; obey(); }
    else if (next != '\r' && filled < 127) line[filled++] = next;
  }
  if (length == 0) return;
  unsigned long since = millis() - begun;
  if (everyMs > 0 && since >= everyMs) { begun += everyMs; since -= everyMs; }
  unsigned long n = since / bitMs;
  digitalWrite(LASER, n >= (unsigned long)length || word[n] == '1' ? HIGH : LOW);
}
