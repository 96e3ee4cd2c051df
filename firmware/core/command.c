#include "command.h"

#include <stddef.h>
#include <string.h>

#include "number.h"

#define NOISE '#' /* is in no valid field */

/* The valid values of a field: one of some letters, or a number within limits. */
typedef struct {
    char kind;
    const char *letters; /* NULL: a number */
    bool whole;
    double lowest, highest;
} Field;

static const Field FIELDS[] = {
    {'W', "dqstwc", false, 0, 0},  /* wave */
    {'L', "oc", false, 0, 0},      /* open or closed loop */
    {'E', "ot", false, 0, 0},      /* encoder one or two */
    {'f', NULL, false, 1e-3, 1e3}, /* frequency, Hz */
    {'a', NULL, true, -1e6, 1e6},  /* amplitude, counts */
    {'n', NULL, true, 1, 1e6},     /* cycles */
    {'g', NULL, false, -1e9, 1e9}, /* gain */
};

/* The letters that begin a command, and the fields that follow. */
static const struct {
    char letter;
    char fields[MOST_FIELDS + 1];
} COMMANDS[] = {
    {'d', "WLEfan"},  /* start: wave, loop, encoder, frequency, amplitude, cycles */
    {'g', "ggg"},     /* PID: kp, ki, kd */
    {'f', "ggggggg"}, /* state feedback: two gains per encoder, prefilter */
    {'c', "f"},       /* last frequency of the next chirps */
    {'z', ""},        /* reset */
    {'s', ""},        /* stop */
    {'k', ""},        /* heartbeat */
    {'?', ""},        /* query */
};

/* The fields after a letter; NULL: it does not begin a command. */
static const char *fields_of(char letter, uint8_t encoders)
{
    for (size_t i = 0; i < sizeof COMMANDS / sizeof *COMMANDS; ++i)
        if (COMMANDS[i].letter == letter)
            return COMMANDS[i].fields + (letter == 'f' ? 2 * (MOST_ENCODERS - encoders) : 0);
    return NULL;
}

static bool read_field(char kind, const char *text, double *value)
{
    const Field *field = FIELDS;
    while (field->kind != kind)
        ++field;
    if (field->letters) {
        *value = text[0];
        return text[0] && !text[1] && strchr(field->letters, text[0]);
    }
    return read_number(text, field->whole, value) && *value >= field->lowest &&
           *value <= field->highest;
}

/* The command that a field begins; 0: no command. */
static char letter_of(const char *text, uint8_t encoders)
{
    const size_t length = strlen(text);
    if (length == 0)
        return '\0';
    const char last = text[length - 1];
    const bool known = length == 1 ? fields_of(last, encoders) != NULL : last == 's' || last == 'z';
    return known ? last : '\0';
}

/* Take a field as the next one of the current command; false: it is wrong in this place. */
static bool take_next(CommandReader *reader, const char *text)
{
    Command *command = &reader->command;
    const char *kinds = fields_of(command->letter, reader->encoders);
    if (!kinds || !kinds[reader->count]) /* no command is begun, or the last one is complete */
        return false;
    if (!read_field(kinds[reader->count], text, &command->fields[reader->count]))
        return false;
    ++reader->count;
    return true;
}

static bool is_complete(const CommandReader *reader)
{
    const char *kinds = fields_of(reader->command.letter, reader->encoders);
    return kinds && !kinds[reader->count];
}

static uint8_t take_field(CommandReader *reader, const char *text)
{
    Command *command = &reader->command;
    uint8_t found = 0;
    if (!take_next(reader, text)) {
        if (command->letter == 'd' && reader->count == 1 && command->fields[0] == 's')
            found = STOP_FOUND;
        command->letter = letter_of(text, reader->encoders);
        reader->count = 0;
    }
    return is_complete(reader) ? found | COMMAND_FOUND : found;
}

static bool is_blank(char c) { return c == ' ' || c == '\t' || c == '\r' || c == '\n'; }

uint8_t command_receive(CommandReader *reader, uint8_t byte)
{
    char *text = reader->text;
    if (byte == ';') {
        while (reader->length && is_blank(text[reader->length - 1]))
            --reader->length;
        text[reader->length] = '\0';
        reader->length = 0;
        return take_field(reader, text);
    }
    if (reader->length == 0 && is_blank((char)byte))
        return 0;
    if (reader->length == LONGEST_FIELD) { /* too long for a field: only its end may still matter */
        text[0] = NOISE;
        --reader->length;
    }
    text[reader->length++] = byte ? (char)byte : NOISE; /* only a semicolon ends a text */
    return 0;
}
